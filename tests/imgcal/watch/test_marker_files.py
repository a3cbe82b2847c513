import resource
import signal
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import InputError
from imgcal.online import ObjectPose
from imgcal.watch import MarkerFile, marker_files
from imgcal.watch.marker_files import TO_FIND_RATE, marker_labels, usual_rate
from imgcal.watch.poses import UnwrittenError
from tests.imgcal.watch.states import OBJECT, RIG
from tests.imgcal.watch.test_poses import record
from tests.imgcal.watch.test_trc_file import rows_of

ezc3d = pytest.importorskip("ezc3d", reason="no ezc3d (extra dev): no independent reader of C3D")


def seen_record(number, hidden=()):
    """A snapshot at 60 Hz in which some fiducials are hidden from all cameras."""
    known = record(number)
    seen = np.ones((4, 8), dtype=bool)
    seen[:, list(hidden)] = False
    pose = replace(known.pose, points_object=OBJECT.points, seen=seen)
    return replace(known, pose=pose)


def points_of(path):
    if path.suffix == ".c3d":
        found = ezc3d.c3d(str(path))
        return found["parameters"]["POINT"]["RATE"]["value"][0], found["data"]["points"][:3].transpose(2, 1, 0)
    head, _, values = rows_of(path)
    return float(head["DataRate"]), values[:, 2:].reshape(len(values), -1, 3)


@pytest.mark.parametrize("suffix", [".c3d", ".trc"])
@pytest.mark.parametrize("count", [3, TO_FIND_RATE + 40])
def test_fiducials_stand_where_the_object_was_at_even_times(tmp_path, suffix, count):
    path = tmp_path / f"trial{suffix}"
    sink, lost = MarkerFile(path, RIG, OBJECT), [number for number in range(count) if number % 11 == 7]
    for number in range(count):
        if number not in lost:
            nothing = number == count - 1
            sink.send(record(number, "no_object") if nothing else seen_record(number, [number % 8]))
    sink.close()
    rate, points = points_of(path)
    assert rate == 60.0 and len(points) == count
    for number, frame in enumerate(points):
        if number in lost or number == count - 1:
            assert np.isnan(frame).all()
            continue
        matrix = record(number).pose.matrix()
        truth = OBJECT.points.numpy() @ matrix[:3, :3].T + matrix[:3, 3]
        assert np.isnan(frame[number % 8]).all()
        rest = np.arange(8) != number % 8
        assert np.allclose(frame[rest], truth[rest], atol=1e-3)


@contextmanager
def full_disk(more):
    """No file can grow beyond `more` bytes."""
    limits, before = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (more, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)


@pytest.mark.parametrize("suffix", [".c3d", ".trc"])
def test_frames_that_a_full_disk_did_not_take_are_empty_and_counted(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"trial{suffix}"
    sink, first, lost = MarkerFile(path, RIG, OBJECT), TO_FIND_RATE, 0
    for number in range(first):
        sink.send(seen_record(number))
    monkeypatch.setattr(marker_files, "WRITE_EVERY", 0.0)
    with full_disk(path.stat().st_size + 50):
        for number in range(first, first + 10):
            with pytest.raises(UnwrittenError) as refused:
                sink.send(seen_record(number))
            lost += refused.value.count
        assert len(points_of(path)[1]) == first  # at any moment
    for number in range(first + 10, first + 20):
        sink.send(seen_record(number))
    sink.close()
    _, points = points_of(path)
    assert lost == 10 and len(points) == first + 20
    for number, frame in enumerate(points):
        assert np.isnan(frame).all() if first <= number < first + 10 else not np.isnan(frame).any()
        if number not in range(first, first + 10):
            truth = seen_record(number).pose.points_rig()[0].numpy()
            assert np.allclose(frame, truth, atol=1e-3)


@pytest.mark.parametrize("suffix", [".c3d", ".trc"])
def test_a_trial_begins_once_its_file_can_be_created(tmp_path, suffix):
    path = tmp_path / f"trial{suffix}"
    sink = MarkerFile(path, RIG, OBJECT)
    for number in range(TO_FIND_RATE - 1):
        sink.send(seen_record(number))
    with full_disk(20), pytest.raises(UnwrittenError) as refused:
        sink.send(seen_record(TO_FIND_RATE))
    assert refused.value.count == TO_FIND_RATE and not path.exists()
    for number in range(TO_FIND_RATE, 2 * TO_FIND_RATE):
        sink.send(seen_record(number))
    sink.close()
    assert len(points_of(path)[1]) == TO_FIND_RATE


@pytest.mark.parametrize("suffix", [".c3d", ".trc"])
def test_what_cannot_be_written_at_the_end_is_counted(tmp_path, suffix):
    sink = MarkerFile(tmp_path / f"trial{suffix}", RIG, OBJECT)
    for number in range(5):
        sink.send(seen_record(number))
    with full_disk(1300 if suffix == ".c3d" else 500), pytest.raises(UnwrittenError) as refused:
        sink.close()
    assert refused.value.count == 5


def test_the_residual_is_the_error_that_a_point_is_expected_to_have(tmp_path):
    random = np.random.default_rng(0)
    covariance = np.diag([1e-6, 4e-6, 9e-6, 0.01, 0.04, 0.09])
    known = seen_record(0)
    pose = replace(known.pose, covariance=torch.from_numpy(covariance))
    points, error = pose.points_rig()
    draws = random.multivariate_normal(np.zeros(6), covariance, 20_000)
    turned = OBJECT.points.numpy() @ pose.matrix()[:3, :3].T
    moved = np.cross(draws[:, None, :3], turned) + draws[:, None, 3:]
    assert np.allclose(np.sqrt((moved**2).sum(-1).mean(0)), error, rtol=0.03)
    assert np.allclose(points, turned + pose.matrix()[:3, 3])
    sink = MarkerFile(tmp_path / "a.c3d", RIG, OBJECT)
    sink.send(replace(known, pose=pose))
    sink.close()
    residual = ezc3d.c3d(str(tmp_path / "a.c3d"))["data"]["meta_points"]["residuals"][0, :, 0]
    assert (residual >= error.numpy() - 1e-6).all() and (residual - error.numpy() < 0.2).all()


def test_a_trial_is_a_new_file_in_a_folder_that_exists(tmp_path):
    (tmp_path / "old.c3d").write_text("somebody's")
    with pytest.raises(InputError, match="exists, expected a new file"):
        MarkerFile(tmp_path / "old.c3d", RIG, OBJECT)
    with pytest.raises(InputError, match="no folder"):
        MarkerFile(tmp_path / "nowhere" / "a.trc", RIG, OBJECT)
    sink = MarkerFile(tmp_path / "empty.c3d", RIG, OBJECT)
    sink.close()  # nothing came
    assert not (tmp_path / "empty.c3d").exists()


def test_a_gap_that_is_no_gap_is_refused_and_labels_are_the_fiducials_names(tmp_path):
    sink = MarkerFile(tmp_path / "a.trc", RIG, OBJECT)
    for number in range(TO_FIND_RATE):
        sink.send(seen_record(number))
    with pytest.raises(OSError, match="a gap of"):
        sink.send(seen_record(10_000_000))
    sink.close()
    assert len(points_of(tmp_path / "a.trc")[1]) == TO_FIND_RATE
    assert marker_labels(OBJECT) == tuple(f"M{number}" for number in range(8))
    assert marker_labels(replace(OBJECT, fiducial_names=tuple("abcdefgh"))) == tuple("abcdefgh")
    assert ObjectPose.points_rig and usual_rate([0.0, 1 / 59.94, 2 / 59.94]) == pytest.approx(59.94)
