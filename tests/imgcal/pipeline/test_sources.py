"""Data passed by a program are checked against the rig and the object, like files."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import Proposal
from imgcal.errors import InputError, RefusedError
from imgcal.io import load_object, read_rig
from imgcal.online import RigKeeper
from imgcal.pipeline import calibrate, calibrate_from_scratch, check_detections, score
from imgcal.synthesis import FrameModel, PhysicalDrift, simulate_frames, simulate_truth, true_detections
from imgcal.types import CalibrationObject


@pytest.fixture(scope="module")
def seen():
    """A small rig, an object, frames and exact blobs of one snapshot."""
    rig, obj = read_rig("T4").resized(torch.tensor([1024, 544])), load_object("asymmetric8")
    generator = torch.Generator().manual_seed(4)
    truth = simulate_truth(rig, obj, 1, generator, PhysicalDrift())
    return rig, obj, next(simulate_frames(truth, obj, FrameModel(), generator)), true_detections(truth)


def update(source, rig, obj):
    with RigKeeper(rig, obj) as keeper:
        return keeper.update(source, 0.0)


EVERYWHERE = pytest.mark.parametrize("job", [calibrate, score, update])


@EVERYWHERE
def test_equal_channels_are_grey_as_in_files(seen, job):
    rig, obj, frames, _ = seen
    coloured = {name: np.repeat(frame[..., None], 3, axis=-1) for name, frame in frames.items()}
    grey, found = job(frames, rig, obj), job(coloured, rig, obj)
    assert np.array_equal(np.asarray(grey.residual), np.asarray(found.residual))
    first = next(iter(frames))
    coloured[first] = coloured[first].copy()
    coloured[first][..., 0] += 9
    with pytest.raises(InputError, match=f"camera {first}: found a colour image .*, expected grey"):
        job(coloured, rig, obj)


def test_a_proposer_sees_grey_frames(seen):
    rig, obj, frames, _ = seen
    coloured = {name: np.repeat(frame[..., None], 3, axis=-1) for name, frame in frames.items()}
    assert calibrate(coloured, rig, obj, detector="matched").detectors == {"matched": 1}


@EVERYWHERE
@pytest.mark.parametrize(
    ("turn", "found"), [(np.rot90, "544x1024"), (lambda frame: np.ascontiguousarray(frame[::2, ::2]), "512x272")]
)
def test_frames_of_another_size_are_no_frames_of_this_rig(seen, job, turn, found):
    rig, obj, frames, _ = seen
    other = {**frames, "cam03": turn(frames["cam03"])}
    with pytest.raises(InputError, match=f"camera cam03: found a frame of {found} pixels, expected 1024x544"):
        job(other, rig, obj)


def test_one_wrong_frame_of_many_is_found(seen):
    rig, obj, frames, _ = seen
    many = {name: [frame, None, frame] for name, frame in frames.items()}
    many["cam02"][2] = np.rot90(many["cam02"][2])
    with pytest.raises(InputError, match="camera cam02"):
        calibrate(many, rig, obj)


@EVERYWHERE
@pytest.mark.parametrize("source", [None, 7, "frames", [1, 2], {"cam01": "x"}, {"cam99": None}, {1: None}])
def test_what_is_neither_frames_nor_blobs_is_said_in_one_line(seen, job, source):
    rig, obj, _, _ = seen
    with pytest.raises(InputError, match="found") as error:
        job(source, rig, obj)
    assert "\n" not in str(error.value)


@EVERYWHERE
@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        (
            "uv",
            (1400.0, 100.0),
            r"found \(1400, 100\) in row 5, expected a pixel of the 1024x544 image of camera cam01",
        ),
        ("uv", (np.nan, 1.0), "expected a pixel"),
        ("sigma", 0.0, "sigma: found 0.0 in row 5"),
        ("sigma", -1.0, "sigma: found -1.0 in row 5"),
        ("sigma", np.inf, "sigma: found inf"),
        ("fiducial", 8, "fiducial: found 8 in row 5, expected a row of the object, 0 to 7"),
        ("camera", 4, "camera: found 4 in row 5, expected 0 to 3"),
        ("snapshot", -1, "snapshot: found -1"),
    ],
)
def test_blobs_that_cannot_be_of_this_rig_or_object(seen, job, column, value, reason):
    rig, obj, _, blobs = seen
    wrong = getattr(blobs, column).copy()
    wrong[5] = value
    with pytest.raises(InputError, match=reason):
        job(replace(blobs, **{column: wrong}), rig, obj)


@pytest.mark.parametrize("job", [calibrate, score])
def test_cameras_that_share_no_snapshot_are_said_to(seen, job):
    rig, obj, _, blobs = seen
    apart = replace(blobs, snapshot=blobs.camera.copy(), snapshot_names=tuple(f"{c}_0" for c in rig.camera_names))
    with pytest.raises(InputError, match=r"no snapshot in which two cameras .*\(cam01: cam01_0; cam02: cam02_0\)"):
        job(apart, rig, obj)


@EVERYWHERE
@pytest.mark.parametrize("column", ["camera", "snapshot", "fiducial", "flags"])
def test_numbers_that_are_not_whole(seen, job, column):
    rig, obj, _, blobs = seen
    wrong = replace(blobs, **{column: getattr(blobs, column).astype(float)})
    with pytest.raises(InputError, match=f"detections: {column}: found an array of float64, expected integers"):
        job(wrong, rig, obj)


@pytest.mark.parametrize("job", [calibrate, score, calibrate_from_scratch])
def test_centres_divided_by_the_size_of_the_image(seen, job):
    """They are told before a fit: at some noise, a rig was accepted that fitted even these."""
    rig, obj, _, blobs = seen
    size = rig.image_size.double().numpy()[blobs.camera]
    with pytest.raises(InputError, match=r"^detections: found u and v between 0.* expected pixels$"):
        job(replace(blobs, uv=(blobs.uv + 0.5) / size), rig, obj)


@EVERYWHERE
def test_a_label_that_a_camera_has_twice(seen, job):
    rig, obj, _, blobs = seen
    twice = blobs.select(np.array([*range(len(blobs)), 5]))
    row = f"found {blobs.fiducial[5]} again in row 32 for camera cam01 in snapshot {blobs.snapshot_names[0]}"
    with pytest.raises(InputError, match=f"detections: fiducial: {row}, expected it once"):
        job(twice, rig, obj)
    assert len(check_detections(replace(twice, fiducial=np.full(len(twice), -1)), rig, obj)) == 33


def test_labels_of_unknown_markers_may_repeat(seen):
    rig, obj, _, blobs = seen
    twice = blobs.select(np.array([*range(len(blobs)), 5]))
    assert not check_detections(twice, rig, CalibrationObject.unknown()).labelled.any()
    both = CalibrationObject.of_several([obj, CalibrationObject.unknown()])
    nameless = replace(twice, fiducial=np.where(twice.fiducial == twice.fiducial[5], 8, twice.fiducial))
    assert set(check_detections(nameless, rig, both).fiducial) == {-1, *range(8)} - {twice.fiducial[5]}


def test_columns_of_different_lengths(seen):
    rig, obj, _, blobs = seen
    with pytest.raises(InputError, match=r"sigma: found an array of shape \(3,\), expected .* \(32,\)"):
        calibrate(replace(blobs, sigma=blobs.sigma[:3]), rig, obj)
    with pytest.raises(InputError, match="uv: found list"):
        calibrate(replace(blobs, uv=blobs.uv.tolist()), rig, obj)


def test_a_score_takes_frames(seen):
    rig, obj, frames, _ = seen
    truth = calibrate(frames, rig, obj).rig
    assert score(frames, truth, obj).distances.max() < 0.2


class Watcher:
    """Proposes nothing, and remembers what it was shown."""

    name = "watcher"

    def __init__(self):
        self.shown = []

    def propose(self, snapshot):
        self.shown.append(snapshot)
        return Proposal.decline(snapshot, "seen enough")


def test_a_proposer_is_shown_the_frames_of_each_snapshot(o10, asymmetric8):
    frames = {name: [np.full((1088, 2048), 7 + s, np.uint8) for s in range(2)] for name in o10.camera_names[:2]}
    watcher = Watcher()
    with pytest.raises(RefusedError, match="seen enough"):
        calibrate(frames, o10, asymmetric8, detector=watcher)
    assert [int(shown.frames["cam02"][0, 0]) for shown in watcher.shown] == [7, 8]
    assert watcher.shown[0].rig.camera_names == o10.camera_names and len(watcher.shown[0].blobs) == 0


def test_who_looks_needs_frames_and_a_name_that_is_known(o10, asymmetric8):
    truth = simulate_truth(o10, asymmetric8, 1, torch.Generator().manual_seed(0), None)
    with pytest.raises(InputError, match="without frames"):
        calibrate(true_detections(truth), o10, asymmetric8, detector=Watcher())
    with pytest.raises(InputError, match="detector: found 'clasical'"):
        calibrate(true_detections(truth), o10, asymmetric8, detector="clasical")
