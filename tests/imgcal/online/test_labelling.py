"""Blobs and labels of one snapshot after another."""

from dataclasses import replace

import numpy as np
import pytest

import imgcal
from imgcal.association import PipelineOptions
from imgcal.detection import DetectionOptions
from imgcal.errors import InputError, RefusedError
from imgcal.online.labelling import Labelling
from scripts.benchmarks.rig_streams import Conditions, Stream


def test_blobs_of_one_snapshot_are_labelled_and_those_of_two_refused() -> None:
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 1, Conditions(clutter=0.0, labelled=True))
    blobs = made.snapshot(0)
    labelling = Labelling(made.factory, made.obj, PipelineOptions(), DetectionOptions(), "classical")
    try:
        named = labelling.blobs(blobs, "7")
        assert named.snapshot_names == ("7",)
        unlabelled = replace(named, fiducial=np.full(len(named), -1))
        found, snapshot = labelling.decide(unlabelled, "7", None, None, None)
        assert snapshot.name == "7"
        np.testing.assert_array_equal(found.fiducial, blobs.fiducial)
        assert not labelling.follows
        assert snapshot.rig_from_object is not None
        labelling.follow(snapshot.rig_from_object)
        assert labelling.follows
        with pytest.raises(RefusedError, match="identity"):
            labelling.decide(unlabelled.select(np.arange(2)), "8", None, None, None)
        assert not labelling.follows
        with pytest.raises(InputError, match="found 2 snapshots"):
            labelling.blobs(replace(blobs, snapshot_names=("0", "1")), "9")
    finally:
        labelling.close()
