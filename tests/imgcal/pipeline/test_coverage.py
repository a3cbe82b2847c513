"""Undetermined values are reported, and the suggested object positions do help."""

from dataclasses import replace

import pytest
import torch

from imgcal.geometry import RigidTransform
from imgcal.io import load_object, read_rig
from imgcal.pipeline import Coverage, calibrate, measure_coverage
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import RigPrior


def std_of(result):
    return result.estimate.covariance(0).diagonal().unflatten(0, (-1, 15)).sqrt()


@pytest.fixture(scope="module")
def narrow():
    """A calibration from a few snapshots in the middle of the images."""
    rig, obj = read_rig("T4"), load_object("asymmetric8")
    truth = simulate_truth(rig, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
    return truth, calibrate(true_detections(truth), rig, obj)


def test_places_reach_what_they_promise(narrow):
    truth, result = narrow
    known = measure_coverage(result, std_of(result))
    assert max(known.coverage) < 0.5
    first, *rest = known.places
    assert all(place.fields <= first.fields for place in rest) and first.cameras <= 4
    body = truth.rig_from_object.rotation[0] @ (obj_points() - obj_points().mean(0)).mT
    seen = result.rig.project(body.mT + torch.tensor(first.rig_from_centre).double())
    fields = [
        {(int(u * 8), int(v * 8)) for u, v in ((uv[ok] + 0.5) / size).tolist()}
        for uv, ok, size in zip(seen.uv, seen.visible, result.rig.image_size, strict=True)
    ]
    before = [
        {(int(u * 8), int(v * 8)) for u, v in ((uv[ok] + 0.5) / size).tolist()}
        for uv, ok, size in zip(
            result.observations.uv.movedim(1, 0), result.observations.seen.movedim(1, 0), result.rig.image_size,
            strict=True,
        )
    ]  # fmt: skip
    assert sum(len(new - old) for new, old in zip(fields, before, strict=True)) == first.fields
    assert [len(old) / 64 for old in before] == pytest.approx(list(known.coverage))


def obj_points():
    return load_object("asymmetric8").points.double()


def test_words_name_values_cameras_and_directions(narrow):
    _, result = narrow
    known = measure_coverage(result, std_of(result))
    assert "k3" in known.undetermined and set(known.undetermined["k3"]) == set(result.rig.camera_names)
    text = " ".join(known.sentences)
    assert "k3 in all cameras" in text and "% of the images" in text
    assert "mm in" in known.advice and "new image cells in" in known.advice


def test_all_is_known_where_the_object_was_everywhere():
    known = Coverage(("a", "b"), (0.9, 0.8), {}, ())
    assert known.sentences == () and known.advice == ""
    some = replace(known, undetermined={"k2": ("a",), "k3": ("a", "b")})
    assert some.sentences == ("Not determined by these data (factory values kept): k2 in a; k3 in all cameras.",)


def test_a_lens_that_is_held_is_not_said_to_be_undetermined(narrow):
    truth, result = narrow
    rig = read_rig("T4")
    held = replace(rig, prior=replace(result.rig.prior or RigPrior(), distortion=1e-6))
    known = measure_coverage(
        found := calibrate(true_detections(truth), held, load_object("asymmetric8")), std_of(found)
    )
    assert not set(known.undetermined) & {"k1", "k2", "p1", "p2", "k3"}


def test_a_wide_capture_covers_more(narrow):
    truth, _ = narrow
    rig, obj = read_rig("T4"), load_object("asymmetric8")
    steps = torch.linspace(-130.0, 130.0, 4, dtype=torch.float64)
    shifts = torch.cat((torch.cartesian_prod(steps, steps), torch.zeros(16, 1)), dim=1).double()
    base = truth.rig_from_object
    poses = RigidTransform(base.rotation[:1].expand(16, 3, 3), base.translation[:1] + shifts)
    image = truth.rig.expand(16).project(poses.apply(obj_points()))
    wide = replace(truth, rig_from_object=poses, uv=image.uv, visible=image.visible)
    result = calibrate(true_detections(wide), rig, obj)
    narrow_known, wide_known = (measure_coverage(r, std_of(r)) for r in (narrow[1], result))
    assert min(wide_known.coverage) > max(narrow_known.coverage)
