from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.io import load_object
from imgcal.pipeline import calibrate, calibrate_from_scratch, unit_doubt
from imgcal.synthesis import HandHeld, PhysicalDrift, arrange_rig, simulate_volume, true_detections
from imgcal.types import ConvexVolume, RigPrior

FACTORY = arrange_rig(
    "ring", 4, 3000.0, height=1800.0, target=(0.0, 0.0, 900.0), prior=RigPrior(0.01, 5.0, 0.01, 0.01, 3)
)
ROUGH = RigPrior(0.15, 25.0, 0.1, 1.0, 1e6)


def capture(obj, snapshots, false=0.0, volume=None, seed=0):
    """A drifted rig, labelled and unlabelled blobs, and cameras of which little is known."""
    generator, rng = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    truth = simulate_volume(
        FACTORY, obj, snapshots, generator, PhysicalDrift(), volume=volume, hand=HandHeld(speed=900.0)
    )
    exact = true_detections(truth)
    labelled = replace(exact, uv=exact.uv + 0.05 * rng.normal(size=exact.uv.shape), sigma=np.full(len(exact), 0.05))
    rows = np.flatnonzero(rng.random(len(labelled)) < false)
    both = labelled.select(np.concatenate((np.arange(len(labelled)), rows)))
    both.uv[len(labelled) :] = rng.random((len(rows), 2)) * [1279, 1023]
    blobs = replace(both, fiducial=np.full(len(both), -1))
    cameras = replace(truth.rig, focal_length=1.12 * truth.rig.focal_length, prior=ROUGH)
    cameras = replace(cameras, distortion=torch.zeros_like(cameras.distortion))
    return truth.rig, labelled, blobs.select(np.lexsort((both.camera, both.snapshot))), cameras


def error(found, truth):
    """Mean error of the distances between cameras, mm."""
    return float(
        (torch.cdist(found.positions, found.positions) - torch.cdist(truth.positions, truth.positions)).abs().mean()
    )


def test_from_scratch_is_as_good_as_from_the_factory():
    wand = load_object("wand4")
    truth, labelled, blobs, cameras = capture(wand, 100, false=0.15)
    factory = calibrate(labelled, FACTORY, wand)
    by_labels, by_blobs = (calibrate_from_scratch(source, cameras, wand) for source in (labelled, blobs))
    assert (by_labels.identity, by_blobs.identity) == ("coded", "unique")
    for found in (by_labels, by_blobs):
        assert found.from_scratch and found.rig.prior is None
        assert found.scale.noticed_from is None  # the rig's size is the object's
        assert found.predicted_error.median_mm < 1.25 * factory.predicted_error.median_mm
        assert error(found.rig, truth) < 3 * error(factory.rig, truth) + 0.5
        assert torch.equal(found.rig.cam_from_rig.rotation[0], torch.eye(3).double())
        assert not found.rig.positions[0].abs().gt(1e-9).any()
        place = (found.rig.volume.low[2] + found.rig.volume.high[2]) / 2
        assert 1500 < place < 4500  # mm in front of the first camera


def test_a_cube_will_do_though_each_image_takes_another_turn_of_it():
    cube = load_object("cube8")
    large = replace(cube, points=2 * cube.points)
    truth, labelled, blobs, cameras = capture(large, 40)
    by_labels, by_blobs = (calibrate_from_scratch(source, cameras, large) for source in (labelled, blobs))
    assert (by_labels.identity, by_blobs.identity) == ("coded", "ambiguous")
    assert error(by_blobs.rig, truth) < 1.5 * error(by_labels.rig, truth) < 3


def test_what_the_data_do_not_say_is_refused():
    wand = load_object("wand4")
    _, labelled, blobs, cameras = capture(wand, 12, volume=ConvexVolume.box((0, 0, 900), (1, 1, 901)))
    with pytest.raises(RefusedError, match=r"say too little|cannot be placed|do not"):
        calibrate_from_scratch(labelled, cameras, wand)
    noise = np.random.default_rng(0).random(blobs.uv.shape) * 1000
    with pytest.raises(RefusedError, match=r"in no snapshot \(12 snapshots tried\)|cannot be placed|misses"):
        calibrate_from_scratch(replace(blobs, uv=noise), cameras, wand)


@pytest.mark.parametrize("has_labels", [True, False])
@pytest.mark.parametrize("mirrored", ["object", "images"])
def test_a_mirrored_object_or_mirrored_images_are_named(mirrored, has_labels):
    body = load_object("asymmetric8")
    large = replace(body, points=4 * body.points)
    _, labelled, blobs, cameras = capture(large, 30)
    seen = labelled if has_labels else blobs
    if mirrored == "object":
        large = replace(large, points=large.points * torch.tensor([1.0, 1.0, -1.0]))
    else:
        width = cameras.image_size[:, 0].numpy()[seen.camera]
        seen = replace(seen, uv=np.stack((width - 1 - seen.uv[:, 0], seen.uv[:, 1]), 1))
    with pytest.raises(RefusedError, match=r"^the object's mirror image fits .* sign, or all images are mirrored; so "):
        calibrate_from_scratch(seen, cameras, large)


def test_an_object_in_metres_is_said():
    wand = load_object("wand4")
    _, labelled, blobs, cameras = capture(wand, 40)
    small = replace(wand, points=wand.points / 1000)
    for source in (labelled, blobs):
        try:
            said = unit_doubt(calibrate_from_scratch(source, cameras, small).factory, small, from_scratch=True)
        except RefusedError as refusal:
            said = refusal.reason
        assert said.startswith("the object seems to be in metres, expected millimetres: it is 0.18 mm large")


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # the first rig's lens of that camera fits nothing
@pytest.mark.parametrize("labels", [True, False])
def test_a_lost_frame_is_named(labels):
    wand = load_object("wand4")
    _, labelled, blobs, cameras = capture(wand, 40)
    source = labelled if labels else blobs
    late = (source.camera == 2) & (source.snapshot >= 20)
    shifted = replace(source, snapshot=source.snapshot - late).select(np.flatnonzero(~late | (source.snapshot > 20)))
    with pytest.raises(RefusedError, match="camera cam03: from snapshot 00020 on, its frames show what the other"):
        calibrate_from_scratch(shifted.select(np.lexsort((shifted.camera, shifted.snapshot))), cameras, wand)


def test_an_object_of_another_shape_is_refused():
    wand = load_object("wand4")
    _, labelled, _, cameras = capture(wand, 60)
    bent = replace(wand, points=wand.points * torch.tensor([1.0, 1.15, 1.0]).double())
    with pytest.raises(RefusedError):
        calibrate_from_scratch(labelled, cameras, bent)
