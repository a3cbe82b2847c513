"""Search for lost cameras: its schedule, its memory, and which labels are accepted."""

import numpy as np
import pytest
import torch

from imgcal.association import PipelineOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring import RigBelief
from imgcal.online import camera_search
from imgcal.online.camera_search import LONGEST_REST, NEARBY_TRIES, REMEMBERED, SUSPICIOUS, Search, Surroundings
from imgcal.online.label_consistency import Checked
from imgcal.online.resection import Resected
from imgcal.types import Detections
from tests.imgcal.streams import Stream

CAMERA = 1


@pytest.fixture(scope="module")
def stream() -> Stream:
    return Stream("T4", "asymmetric8", 2)


@pytest.fixture
def tries(monkeypatch):
    """Counts what is dear, which finds nothing."""
    counts = {"nearby": 0, "anywhere": 0}

    def nearby(*given):
        counts["nearby"] += 1

    def anywhere(blobs, places, lens, std, generator):
        counts["anywhere"] += 1
        assert len(blobs) == len(places) <= camera_search.ASKED_TOGETHER

    monkeypatch.setattr(camera_search, "relabel_moved_camera", nearby)
    monkeypatch.setattr(camera_search, "resect_camera", anywhere)
    return counts


def known(stream: Stream) -> Surroundings:
    std = 0.05 * stream.rig.prior.std(stream.rig)
    belief = RigBelief.of_prior(stream.true, stream.obj, std)
    return Surroundings(belief, stream.rig, stream.obj, PipelineOptions())


def seen(stream: Stream, own: np.ndarray | None, fiducial: int = -1) -> Checked:
    """Where one camera sees other blobs than the object's, the first with a label that came by chance."""
    pose = stream.poses[0]
    uv = stream.true.project(pose.apply(stream.obj.points), stream.obj.radius).uv.numpy()
    parts = [own if own is not None and c == CAMERA else uv[c] for c in range(len(uv))]
    camera = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    labels = np.concatenate([np.arange(len(part)) for part in parts])
    if own is not None:
        labels[camera == CAMERA] = -1
        labels[np.flatnonzero(camera == CAMERA)[0]] = fiducial
    zeros = np.zeros(len(camera), dtype=np.int64)
    blobs = Detections(
        np.concatenate(parts), np.full(len(camera), 0.1), camera, zeros, labels, np.full(len(camera), 5.0),
        zeros.astype(np.uint8), stream.rig.camera_names, ("0",),
    )  # fmt: skip
    off = np.zeros(len(parts), dtype=bool)
    return Checked(
        blobs, blobs, RigidTransform(pose.rotation[None], pose.translation[None]), off, 0.1, int((labels >= 0).sum())
    )


def strangers(count: int = 6) -> np.ndarray:
    return np.random.default_rng(0).uniform((300, 200), (1500, 800), (count, 2))


def test_a_camera_that_is_not_found_costs_ever_less(stream, tries) -> None:
    looks, number = Search(4), 0
    for number in range(3 * LONGEST_REST):
        checked, missed = looks.label_lost_cameras(seen(stream, strangers()), known(stream), number / 60, number)
        looks.observe(checked.blobs, number)
        assert missed == {CAMERA} and not checked.off.any()
    assert looks.sought[CAMERA].taken == number + 1 and looks.lost_since(CAMERA, 99.0) == 0.0
    assert len(looks.sought[CAMERA].blobs) == len(looks.sought[CAMERA].places) == REMEMBERED
    everywhere = int(np.log2(LONGEST_REST)) + 1 + 2  # after 1, 2, 4, ..., and then every so often
    assert tries["anywhere"] == everywhere and tries["nearby"] <= NEARBY_TRIES + everywhere


def test_a_snapshot_that_is_labelled_twice_counts_once(stream, tries) -> None:
    looks = Search(4)
    for _ in range(2):
        looks.label_lost_cameras(seen(stream, strangers()), known(stream), 0.0, 7)
    assert looks.sought[CAMERA].taken == 1 and len(looks.sought[CAMERA].blobs) == 1


def test_labels_by_chance_are_not_believed_and_what_is_strange_does_not_become_usual(stream, tries) -> None:
    looks = Search(4)
    for number in range(40):
        checked, missed = looks.label_lost_cameras(seen(stream, strangers(), fiducial=2), known(stream), 0.0, number)
        looks.observe(checked.blobs, number)
        assert missed == {CAMERA}
        assert (checked.blobs.fiducial[checked.blobs.camera == CAMERA] == -1).all() and checked.labels == 24
    checked, missed = looks.label_lost_cameras(seen(stream, None), known(stream), 1.0, 40)
    looks.observe(checked.blobs, 40)
    assert not missed and not looks.sought and checked.labels == 32


def test_few_blobs_are_looked_into_once_they_have_come_again(stream, tries) -> None:
    looks, told = Search(4), []
    for number in range(SUSPICIOUS + 1):
        checked, missed = looks.label_lost_cameras(seen(stream, strangers(3)), known(stream), 0.0, number)
        looks.observe(checked.blobs, number)
        told.append(bool(missed))
    assert told == [False] * SUSPICIOUS + [True]


def test_a_camera_that_only_lost_its_labels_has_not_moved(stream) -> None:
    """Blobs that following left without labels, all at their places: they get them, and nothing is off."""
    pose = stream.poses[0]
    uv = stream.true.project(pose.apply(stream.obj.points), stream.obj.radius).uv[CAMERA].numpy()
    own = uv + np.random.default_rng(1).normal(0, 0.1, uv.shape)
    looks = Search(4)
    checked, missed = looks.label_lost_cameras(seen(stream, own), known(stream), 0.0, 0)
    assert not missed and not checked.off.any() and not looks.sought
    labels = checked.blobs.fiducial[checked.blobs.camera == CAMERA]
    assert labels.tolist() == list(range(len(own))) and checked.labels == 32


@pytest.mark.parametrize(("in_place", "missing"), [(2, True), (3, False)])
def test_a_third_of_the_object_in_place_is_not_elsewhere(stream, tries, in_place, missing) -> None:
    """The others merge: a wand seen end-on leaves too few blobs for labels, among false ones."""
    pose = stream.poses[0]
    uv = stream.true.project(pose.apply(stream.obj.points), stream.obj.radius).uv[CAMERA, :in_place].numpy()
    own = np.concatenate([strangers(6), uv + 0.1])
    _, missed = Search(4).label_lost_cameras(seen(stream, own), known(stream), 0.0, 0)
    assert missed == (frozenset({CAMERA}) if missing else frozenset())


def test_where_a_camera_was_found_it_is_found_again_without_a_search(stream, monkeypatch) -> None:
    turned = stream.bumped([CAMERA], 20.0)
    pose = stream.poses[0]
    now = turned.project(pose.apply(stream.obj.points), stream.obj.radius)
    rows = np.flatnonzero(now.visible[CAMERA].numpy())
    assert len(rows) >= 4
    asked = []

    def anywhere(blobs, places, lens, std, generator):
        asked.append(len(blobs))
        return None if len(asked) == 1 else Resected(rows, turned.select([CAMERA]))

    monkeypatch.setattr(camera_search, "relabel_moved_camera", lambda *given: None)
    monkeypatch.setattr(camera_search, "resect_camera", anywhere)
    looks = Search(4)
    own, truth = now.uv[CAMERA].numpy()[rows], rows
    for number in range(8):
        checked, missed = looks.label_lost_cameras(seen(stream, own), known(stream), 0.0, number)
        looks.observe(checked.blobs, number)
        found = checked.blobs.fiducial[checked.blobs.camera == CAMERA]
        if number == 0:
            assert missed == {CAMERA}
        else:
            assert not missed and checked.off.tolist() == [False, True, False, False]
            np.testing.assert_array_equal(found, truth)
    assert asked == [1, 2]
    assert torch.equal(looks.sought[CAMERA].place.positions, turned.select([CAMERA]).positions)
