from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import associate, identification, match_to_rig, series, to_observations, tracker
from imgcal.errors import InputError, RefusedError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import CalibrationObject


@pytest.fixture(scope="module")
def seen(o10, asymmetric8):
    """Four snapshots, noise-free, labelled."""
    return true_detections(simulate_truth(o10, asymmetric8, 4, torch.Generator().manual_seed(0), PhysicalDrift()))


def without_labels(detections):
    return replace(detections, fiducial=np.full(len(detections), -1))


def test_labels_are_found_again(seen, o10, asymmetric8):
    labelled = associate(without_labels(seen), o10, asymmetric8)
    assert np.array_equal(labelled.detections.fiducial, seen.fiducial)
    assert labelled.identity == "unique"
    assert labelled.used == [0, 1, 2, 3]


def test_one_dark_snapshot_is_left_out(seen, o10, asymmetric8):
    labelled = associate(without_labels(seen.select(seen.snapshot != 2)), o10, asymmetric8)
    assert labelled.used == [0, 1, 3]
    assert labelled.snapshots[2].status == "refused"
    assert "blobs" in labelled.snapshots[2].reason


def test_nothing_seen_is_refused(seen, o10, asymmetric8):
    with pytest.raises(RefusedError, match="4 of 4 snapshots"):
        associate(without_labels(seen.select(seen.snapshot > 9)), o10, asymmetric8)


def test_cameras_are_put_in_the_order_of_the_rig(seen, o10):
    reordered = tuple(reversed(seen.camera_names))
    other = replace(seen, camera_names=reordered, camera=9 - seen.camera)
    assert np.array_equal(match_to_rig(other, o10).camera, seen.camera)
    with pytest.raises(InputError, match="cam99"):
        match_to_rig(replace(seen, camera_names=("cam99", *seen.camera_names[1:])), o10)


def test_observations_are_dense(seen, o10, asymmetric8):
    missing = seen.select(~((seen.camera == 3) & (seen.fiducial == 5)))
    observations = to_observations(missing, o10, asymmetric8)
    assert observations.uv.shape == (4, 10, 8, 2)
    assert int(observations.seen.sum()) == 4 * 79 and not observations.seen[:, 3, 5].any()
    row = np.flatnonzero((seen.snapshot == 2) & (seen.camera == 7) & (seen.fiducial == 1))[0]
    assert np.array_equal(observations.uv[2, 7, 1].numpy(), seen.uv[row])


def test_rows_that_come_three_times_and_in_any_order_change_nothing(seen, o10, asymmetric8):
    rows = np.random.default_rng(0).permutation(np.repeat(np.arange(len(seen)), 3))
    labelled = associate(without_labels(seen.select(rows)), o10, asymmetric8)
    once = associate(without_labels(seen), o10, asymmetric8)
    assert labelled.used == once.used
    observed = [to_observations(found.detections, o10, asymmetric8) for found in (labelled, once)]
    assert torch.equal(observed[0].seen, observed[1].seen) and torch.equal(observed[0].uv, observed[1].uv)


@pytest.mark.parametrize("fiducials", [slice(0, 1), slice(0, 2)])
def test_blobs_all_in_few_places_are_refused(fiducials, seen, o10, asymmetric8):
    few = seen.select(np.isin(seen.fiducial, np.arange(8)[fiducials]) & (seen.snapshot == 0))
    many = without_labels(few.select(np.repeat(np.arange(len(few)), 40)))
    with pytest.raises(RefusedError, match="too few blobs") as refused:
        associate(many, o10, asymmetric8)
    assert refused.value.for_command.endswith("try --detector auto")


def test_tens_of_thousands_of_snapshots_are_split_in_one_pass(seen, o10, asymmetric8, monkeypatch):
    """Effort is counted in comparisons of whole columns: a few, not a few for each snapshot."""
    snapshots = 20_000
    number = np.repeat(np.arange(snapshots), len(seen) // 4).view(Counted)
    long = seen.select(np.tile(np.flatnonzero(seen.snapshot == 0), snapshots))
    names = tuple(map(str, range(snapshots)))
    monkeypatch.setattr(Counted, "comparisons", 0)
    labelled = associate(replace(long, snapshot=number, snapshot_names=names), o10, asymmetric8)
    assert len(labelled.used) == snapshots
    assert Counted.comparisons < 10


class Counted(np.ndarray):
    """An array that counts how often it is compared as a whole."""

    comparisons = 0

    def __eq__(self, other):
        Counted.comparisons += 1
        return super().__eq__(other)

    __hash__ = None


@pytest.mark.parametrize("count", [8, 60])
def test_a_wrong_object_is_refused_with_an_effort_that_does_not_grow_with_the_capture(count, seen, o10, monkeypatch):
    points = 80 * np.random.default_rng(0).standard_normal((8, 3))
    wrong = CalibrationObject(torch.from_numpy(points), torch.ones(8, 3, dtype=torch.float64))
    spent = []

    def counted(*arguments, **options):
        spent.append(identification.identify_with(*arguments, **options))
        return spent[-1]

    monkeypatch.setattr(series, "MOST_IN_VAIN", 250_000)
    monkeypatch.setattr(tracker, "identify_with", counted)
    rows = np.concatenate([np.flatnonzero(seen.snapshot == s % 4) for s in range(count)])
    names = tuple(map(str, range(count)))
    long = replace(seen.select(rows), snapshot=np.repeat(np.arange(count), len(seen) // 4), snapshot_names=names)
    with pytest.raises(RefusedError, match=r"explains .* snapshots( tried, 60 in all)?\)"):
        associate(without_labels(long), o10, wrong)
    effort = [found.hypotheses for found in spent]
    assert min(effort) > 0
    assert sum(effort) <= 2 * 250_000 + 2 * max(effort)


def test_what_comes_late_in_a_long_capture_is_still_found(seen, o10, asymmetric8, monkeypatch):
    """Snapshots of clutter use up the patience long before the object comes into view."""
    monkeypatch.setattr(series, "MOST_IN_VAIN", 200_000)
    once = np.flatnonzero(seen.snapshot == 0)
    long = seen.select(np.tile(once, 24))
    number, names = np.repeat(np.arange(24), len(once)), tuple(map(str, range(24)))
    clutter = np.random.default_rng(0).uniform(0, 1, long.uv.shape) * (2048, 1088)
    long = replace(long, uv=np.where(number[:, None] < 16, clutter, long.uv), snapshot=number, snapshot_names=names)
    assert associate(without_labels(long), o10, asymmetric8).used == list(range(16, 24))


@pytest.fixture
def trackers(monkeypatch) -> list:
    """Trackers that were made; each keeps the names of the snapshots that it decided, and the poses it started from."""
    made = []

    class Kept(tracker.Tracker):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            self.tried, self.starts = [], []
            made.append(self)

        def decide(self, blobs, name, *how):
            self.tried.append(name)
            self.starts.append(self.pose)
            return super().decide(blobs, name, *how)

    monkeypatch.setattr(series, "Tracker", Kept)
    return made


def test_a_snapshot_that_is_tried_again_teaches_the_rig_once(seen, o10, asymmetric8, trackers):
    clutter = (seen.snapshot == 1) & (seen.camera == 3)  # a camera in which nothing is the object's
    uv = np.where(clutter[:, None], np.random.default_rng(0).uniform(0, 1000, seen.uv.shape), seen.uv)
    labelled = associate(without_labels(replace(seen, uv=uv)), o10, asymmetric8)
    (kept,) = trackers
    first, again = kept.tried[:4], kept.tried[4:]
    assert first == list(seen.snapshot_names) and again == [seen.snapshot_names[1]] and labelled.used == [0, 1, 2, 3]
    assert len(kept.learnt.accepted) == 4
    pose = labelled.snapshots[1].rig_from_object
    torch.testing.assert_close(kept.starts[4].translation, pose.translation, atol=0.5, rtol=0)


def test_stray_lights_are_looked_at_again_only_with_a_better_rig(o10, asymmetric8, trackers):
    """The rig is fitted to 1, 2 and 4 snapshots: after the fifth there is nothing new to try."""
    seen = true_detections(simulate_truth(o10, asymmetric8, 5, torch.Generator().manual_seed(0), PhysicalDrift()))
    stray = np.isin(seen.snapshot, (1, 4)) & (seen.camera == 3)
    kept = seen.select(~stray | (seen.fiducial == 0))  # of camera 3 a single blob is left in the second and the fifth
    kept = replace(kept, uv=np.where((kept.fiducial == 0)[:, None] & (kept.camera == 3)[:, None], 5.0, kept.uv))
    kept = kept.select((kept.camera != 3) | np.isin(kept.snapshot, (1, 4)))
    labelled = associate(without_labels(kept), o10, asymmetric8)
    assert labelled.used == [0, 1, 2, 3, 4]
    assert trackers[0].tried[5:] == [seen.snapshot_names[1]]


def turning(obj, distance: float, rad: float, count: int) -> RigidTransform:
    """Poses of an object that turns about its centroid by the same angle from snapshot to snapshot."""
    axis = torch.tensor([0.3, 0.2, 1.0]).double()
    rotation = rotation_from_vector(rad * torch.arange(count).double()[:, None] * axis / axis.norm())
    there = torch.tensor([0.0, 0.0, distance]).double()
    return RigidTransform(rotation, there - rotation @ obj.points.double().mean(0))


@pytest.fixture
def searches(monkeypatch) -> list:
    """One entry for each search for a pose."""
    made = []
    search = identification._relocalize
    monkeypatch.setattr(identification, "_relocalize", lambda *given: made.append(0) or search(*given))
    return made


def test_an_object_that_moves_on_is_followed_not_searched_for(o10, asymmetric8, searches):
    truth = simulate_truth(o10, asymmetric8, 10, torch.Generator().manual_seed(0), None)
    poses = turning(asymmetric8, o10.working_distance, 0.5, 10)
    uv = truth.rig.expand(10).project(poses.apply(asymmetric8.points.double())).uv
    seen = true_detections(replace(truth, rig_from_object=poses, uv=uv))
    found = associate(without_labels(seen), o10, asymmetric8)
    assert np.array_equal(found.detections.fiducial, seen.fiducial)
    assert len(searches) <= 4  # until three snapshots show how it moves


def test_a_refused_snapshot_is_searched_again_only_with_a_better_rig(seen, o10, asymmetric8, searches):
    noise = np.random.default_rng(0).uniform(0, 1000, seen.uv.shape)
    for number, times in ((3, 4), (1, 5)):  # each is searched once, and the second again: the third changes the rig
        uv = np.where((seen.snapshot == number)[:, None], noise, seen.uv)
        before = len(searches)
        assert number not in associate(without_labels(replace(seen, uv=uv)), o10, asymmetric8).used
        assert len(searches) - before == times
