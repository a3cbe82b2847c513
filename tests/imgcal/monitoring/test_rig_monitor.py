"""A camera is bumped while the rig is in use: which, when, how, how far; and the others stay known."""

import contextlib
import math
from dataclasses import replace

import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.monitoring import CHANGES, Change, RigMonitor, explanations
from imgcal.monitoring.case import Case
from imgcal.monitoring.change_search import ALARM_CHI2
from imgcal.monitoring.explanations import Diagnosis, Steady, Verdict, weigh
from imgcal.monitoring.pending_change import PendingChange
from imgcal.monitoring.rig_monitor import _shift
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import CameraRig, Observations
from scripts.benchmarks.rig_streams import Bump, Conditions, Slip, Stream
from tests.imgcal.monitoring.followed import followed as steadily
from tests.imgcal.monitoring.followed import monitor_of

NOISE = 0.1
SIZES = {"rotation": math.radians(0.1), "position": 1.0, "focal_length": 3.0, "principal_point": 1.0}


def followed(
    bumps: dict[int, dict[int, str]],
    count: int,
    seed: int,
    noise: float = NOISE,
    wrong: int | None = None,
    rate: float = 60.0,
) -> tuple[RigMonitor, CameraRig, list[Change]]:
    """Follow a rig of which cameras are bumped before some snapshots: {snapshot: {camera: kind}}.

    In the first snapshot, two labels of the camera `wrong` are pixels off, as of markers that are half hidden.
    """
    factory, obj, generator = (
        imgcal.load_rig("T4"),
        imgcal.load_object("asymmetric8"),
        torch.Generator().manual_seed(seed),
    )
    truth = simulate_truth(factory, obj, count, generator, PhysicalDrift())
    monitor, rig, told = monitor_of(factory, obj), truth.rig, []
    for s in range(count):
        for camera, kind in bumps.get(s, {}).items():
            part, step = CHANGES[kind], torch.zeros(4, 15, dtype=torch.float64)
            direction = torch.randn(part.stop - part.start, generator=generator, dtype=torch.float64)
            step[camera, part] = SIZES[kind] * direction / direction.norm()
            rig = rig.retract(step)
        pose = truth.rig_from_object[s : s + 1]
        shift = torch.tensor([100.0, 60.0, 80.0]) * torch.randn(3, generator=generator, dtype=torch.float64)
        pose = RigidTransform(pose.rotation, pose.translation + shift)
        image = rig.expand(1).project(pose.apply(obj.points))
        uv = image.uv + noise * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
        seen = image.visible & (torch.rand(image.visible.shape, generator=generator) > 0.1)
        if s == 0 and wrong is not None:
            uv[0, wrong, 2:4] += torch.tensor([[3.0, 4.0], [-4.0, 2.0]])
        observations = Observations(uv, torch.full(seen.shape, noise, dtype=torch.float64), seen)
        found = monitor.update(observations, pose, seconds=1 / rate)
        one = found.update
        assert len(one.rig_from_object.translation) == len(one.residual) == 1  # also where it was learnt anew
        told += found.changes
    return monitor, rig, told


def normalized_error(monitor: RigMonitor, rig: CameraRig) -> float:
    """Squared error of the filter per degree of freedom."""
    belief = monitor.filter.belief
    error = belief.rig.local(rig).flatten()
    return float(error @ torch.linalg.solve(belief.covariance(), error)) / len(error)


def test_a_steady_rig_gives_no_alarm() -> None:
    monitor, rig, told = followed({}, 70, seed=4)
    assert told == []
    assert 0.6 < normalized_error(monitor, rig) < 1.5


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_camera_with_wrong_labels_in_the_first_snapshot_has_not_moved(seed: int) -> None:
    monitor, rig, told = followed({}, 12, seed, noise=0.005, wrong=2, rate=0.5)
    assert told == []
    assert monitor.known_since == 0  # all that the other cameras have shown still counts
    assert 0.4 < normalized_error(monitor, rig) < 1.8


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("at", [2, 4])
def test_a_camera_that_moves_after_two_precise_snapshots_is_reported(seed: int, at: int) -> None:
    monitor, rig, told = followed({at: {2: "rotation"}}, 16, seed, noise=0.02, rate=0.5)
    assert {(change.camera, change.since) for change in told} == {(2, at)}
    assert 0.4 < normalized_error(monitor, rig) < 1.8


@pytest.mark.parametrize(
    ("kind", "camera"), [("rotation", 0), ("position", 1), ("focal_length", 2), ("principal_point", 3)]
)
def test_a_bump_is_told_with_camera_kind_and_size(camera: int, kind: str) -> None:
    # A shifted lens and a tilted camera are told apart slowly.
    count = 300 if kind == "principal_point" else 64
    monitor, rig, told = followed({30: {camera: kind}}, count, seed=10 + camera)
    alarm, change = told
    assert (alarm.camera, alarm.kind) == (camera, "unknown")
    assert abs(alarm.since - 30) <= 3
    assert (change.camera, change.kind, change.decided) == (camera, kind, True)
    assert abs(change.size - SIZES[kind]) < 4 * change.sigma < 0.5 * SIZES[kind]
    assert alarm.evidence >= ALARM_CHI2 and change.evidence >= ALARM_CHI2
    assert 0.5 < normalized_error(monitor, rig) < 1.8
    assert monitor.open == {}


def test_a_camera_that_changes_while_a_change_of_another_is_open_for_longer_than_snapshots_are_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monitor, _, _ = followed({30: {1: "focal_length"}}, 33, seed=12)
    assert monitor._pending is not None
    monkeypatch.setattr(type(monitor._pending), "due", False)
    everything = "imgcal.monitoring.rig_monitor.likeliest_age"
    monkeypatch.setattr(everything, lambda recent, camera, age: 64 if len(recent) == 64 else age)
    monitor, _, told = followed({30: {1: "focal_length"}, 94: {2: "focal_length"}}, 100, seed=12)
    assert monitor.filter.count == 100 and told[0].camera == 1


def test_a_change_that_is_decided_is_reported_though_the_next_one_cannot_be(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, own = [], Diagnosis.decide

    def decide_first(self, case, *rest):
        asked.append(case.cameras)
        if asked[0] != case.cameras:
            raise RefusedError("not yet")
        return own(self, case, *rest)

    monkeypatch.setattr(Diagnosis, "decide", lambda self, case, patient: decide_first(self, case, patient))
    monkeypatch.setattr(PendingChange, "due", False)
    monitor, _, told = followed({30: {1: "focal_length"}, 50: {2: "rotation"}}, 60, seed=12)
    assert (2,) in asked and 2 in monitor.undecided
    assert [(change.camera, change.decided) for change in told] == [(1, False), (1, True)]


def test_two_cameras_at_once() -> None:
    _, _, told = followed({30: {1: "rotation", 3: "principal_point"}}, 300, seed=21)
    assert {change.camera for change in told} == {1, 3}
    assert {change.camera: change.kind for change in told} == {1: "rotation", 3: "principal_point"}


def test_the_others_stay_known() -> None:
    before, _, _ = followed({}, 30, seed=12)
    after, _, told = followed({30: {2: "focal_length"}}, 33, seed=12)
    assert told[0].camera == 2
    known, now = before.filter.belief.std(), after.filter.belief.std()
    others = [0, 1, 3]
    assert (now[others, 6:10] < 1.15 * known[others, 6:10]).all()
    assert (now[2, 6:8] > 1.05 * known[2, 6:8]).all()


@pytest.mark.parametrize("told_before", [False, True])
def test_a_large_turn_is_learnt_whether_it_was_announced_or_not(told_before: bool) -> None:
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(6)
    truth = simulate_truth(factory, obj, 26, generator, PhysicalDrift())
    monitor, rig, told, refused = monitor_of(factory, obj), truth.rig, [], 0
    for s in range(26):
        if s == 20:
            step = torch.zeros(4, 15, dtype=torch.float64)
            step[2, :3] = torch.tensor([0.12, -0.15, 0.05])
            rig = rig.retract(step)
        image = rig.expand(1).project(truth.rig_from_object[s : s + 1].apply(obj.points))
        uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
        observations = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), image.depth > 0)
        moved = (2,) if told_before and s == 20 else ()
        try:
            found = monitor.update(observations, truth.rig_from_object[s : s + 1], 1 / 60, moved)
        except RefusedError:
            refused += 1
            continue
        told += found.changes
    assert refused <= (0 if told_before else 2)
    assert {change.camera for change in told} == {2}
    assert told[0].since == 20
    assert 0.3 < normalized_error(monitor, rig) < 1.8


@pytest.mark.parametrize(
    ("seed", "at", "camera", "kind", "size"),
    [
        (12, 5, 0, "rotation", 0.0095),
        (20, 5, 2, "position", 9.17),
        (26, 7, 2, "position", 7.55),
        (23, 14, 2, "rotation", 0.005),
    ],
)
def test_of_a_camera_that_moves_within_the_first_snapshots_no_other_and_no_object_is_blamed(
    seed: int, at: int, camera: int, kind: str, size: float
) -> None:
    seen = Conditions(rate=60.0 if seed == 23 else 1.0, labelled=True)
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), seed, seen, [Bump(at, camera, kind, size)])
    times = torch.arange(50, dtype=torch.float64) / seen.rate
    made.frequency = made.frequency * seen.rate / 60
    poses, (observations, rigs) = made.poses_at(times), made.labelled(0, 50)
    monitor, told, restarts = monitor_of(made.factory, made.obj), [], 0
    for s in range(50):
        one = observations.of_snapshots([s])
        found = monitor.update(one, poses[s : s + 1], 1 / seen.rate)
        told += found.changes
        restarts += found.restarted
        assert found.object_change is None
    assert {change.camera for change in told} == {camera}
    assert monitor.known_since == at and restarts == 1
    assert 0.5 < normalized_error(monitor, rigs[-1]) < 1.8


def test_a_camera_of_which_it_cannot_be_told_yet_is_undecided_until_it_is() -> None:
    """At 30 snapshots a second the first ones do not tell a camera that has moved from one that always was late."""
    bump = Bump(4, 2, "rotation", 0.005)
    conditions = Conditions(labelled=True, rate=30.0)
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 23, conditions, [bump])
    poses, (observations, _) = made.poses_at(torch.arange(60, dtype=torch.float64) / 30), made.labelled(0, 60)
    monitor, told, undecided = monitor_of(made.factory, made.obj), [], []
    for s in range(60):
        one = observations.of_snapshots([s])
        told += [(s, change.camera) for change in monitor.update(one, poses[s : s + 1], 1 / 30).changes]
        undecided.append(set(monitor.undecided))
    assert told and {camera for _, camera in told} == {2}
    first = told[0][0]
    assert undecided[:4] == [set()] * 4 and undecided[first:] == [set()] * (60 - first)
    assert first > 8 and undecided[6:first] == [{2}] * (first - 6)


def test_an_undecided_camera_is_weighed_less_and_less_often(monkeypatch) -> None:
    """It is late from the first snapshot on, which takes some forty snapshots to tell."""
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 0, Conditions(), slips=[Slip(0, 1, 0.02)])
    states, weighed = list[imgcal.RigState](), list[int]()

    def count(case: Case, *rest) -> Verdict:
        if case.cameras and not case.quarantined:
            weighed.append(len(states))
        return weigh(case, *rest)

    monkeypatch.setattr(explanations, "weigh", count)
    with imgcal.RigKeeper(made.factory, made.obj) as keeper:
        for time, blobs in made.snapshots(40):
            states.append(keeper.update(blobs, time))
    late = [n for n in weighed if n >= 20]
    assert late and len(late) <= 8  # of twenty snapshots
    assert weighed[0] <= 5


def watched(stream: Stream, count: int) -> list[tuple[int, int]]:
    """Follow labelled snapshots: number and camera of each change that was told."""
    seen, _ = stream.labelled(0, count)
    rate = stream.conditions.rate
    poses = stream.poses_at(torch.arange(count, dtype=torch.float64) / rate)
    monitor, told = monitor_of(stream.factory, stream.obj), []
    for number in range(count):
        with contextlib.suppress(RefusedError):
            found = monitor.update(seen.of_snapshots([number]), poses[number : number + 1], 1 / rate)
            told += [(number, change.camera) for change in found.changes]
    return told


def test_two_cameras_are_followed_for_as_long_as_drift_is_learnt() -> None:
    rig, obj = imgcal.load_rig("T4").select([0, 1]), imgcal.load_object("asymmetric8")
    assert watched(Stream(rig, obj, 1, Conditions(rate=1.0, labelled=True)), 200) == []


def test_a_bump_of_which_it_cannot_be_told_yet_is_not_learnt_as_drift() -> None:
    """One snapshot a second of cameras that shake: the question is open when a stretch of drift ends."""
    rig, obj, bump = (
        imgcal.load_rig("T4"),
        imgcal.load_object("asymmetric8"),
        Bump(150, 1, "rotation", math.radians(0.1)),
    )
    told = watched(Stream(rig, obj, 5, Conditions(rate=1.0, shake=0.3, labelled=True), [bump]), 180)
    assert told and {camera for _, camera in told} == {1}
    assert 150 <= told[0][0] <= 160


def test_a_camera_that_was_held_and_surely_stands_still_is_learnt_from_what_it_saw_meanwhile(monkeypatch) -> None:
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 4, Conditions(labelled=True))
    seen, _ = made.labelled(0, 40)
    poses = made.poses_at(torch.arange(40, dtype=torch.float64) / 60)
    monitor, learnt = monitor_of(made.factory, made.obj), []
    restart = monitor.filter.restart
    monitor.filter.restart = lambda *given, **new: learnt.append(len(given[1])) or restart(*given, **new)  # type: ignore[method-assign, func-returns-value]
    monkeypatch.setattr(Diagnosis, "decide", lambda _, case, patient: weigh(case, [Steady()]))
    for number in range(40):
        held = (2,) if number == 30 else ()
        monitor.update(seen.of_snapshots([number]), poses[number : number + 1], 1 / 60, moved=held)
    assert not monitor.quarantine.cameras and learnt == [1]


def test_an_error_that_begins_in_quarantine_may_pass_too() -> None:
    """The camera was in its place meanwhile, so the time before the error says nothing about how long it lasts."""
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 4, Conditions(labelled=True))
    poses = made.poses_at(torch.arange(240, dtype=torch.float64) / 60)
    seen, _ = made.labelled(0, 240)
    seen.uv[95:110, 2] += 2.5
    monitor, told = monitor_of(made.factory, made.obj), []
    monitor.noise.usual = 2.0  # errors last, as on real streams
    monitor.noise.time = torch.full((4,), 2.0, dtype=torch.float64)
    for number in range(240):
        off = (2,) if number == 60 else ()
        told += monitor.update(seen.of_snapshots([number]), poses[number : number + 1], 1 / 60, moved=off).changes
    assert told == []
    assert not monitor.quarantine.cameras


def test_of_two_cameras_in_quarantine_only_the_one_whose_image_is_shifted_has_moved() -> None:
    """The labels of camera 2 do not fit for one snapshot, and fit again when the case is decided."""
    bump = Bump(90, 1, "rotation", math.radians(0.1))
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 4, Conditions(labelled=True), bumps=[bump])
    poses = made.poses_at(torch.arange(150, dtype=torch.float64) / 60)
    seen, _ = made.labelled(0, 150)
    monitor, told = monitor_of(made.factory, made.obj), []
    monitor.noise.usual = 2.0  # errors last, as on real streams
    monitor.noise.time = torch.full((4,), 2.0, dtype=torch.float64)
    for number in range(150):
        off = (1, 2) if number == 90 else ()
        found = monitor.update(seen.of_snapshots([number]), poses[number : number + 1], 1 / 60, moved=off)
        told += [(number, change.camera) for change in found.changes]
    assert {camera for _, camera in told} == {1}
    assert told[0][0] <= 90 + 30  # half a second: the error of camera 2 may pass for longer
    assert not monitor.quarantine.cameras


@pytest.mark.parametrize(("shifts", "shifted"), [((2.0, 2.0), (2,)), ((2.0, 0.0), ()), ((2.0, 2.0, 0.0), (2,))])
def test_a_camera_that_sees_the_object_in_its_place_again_has_not_moved(shifts: tuple[float, ...], shifted) -> None:
    made, monitor = steadily(20), monitor_of(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"))
    monitor.noise.time[:], monitor.noise.lasting[:] = 4.0, 0.05
    latest = []
    for (observations, pose), shift in zip(made.snapshots[-len(shifts) :], shifts, strict=True):
        uv = observations.uv.clone()
        uv[0, 2, :, 0] += shift
        latest.append((replace(observations, uv=uv), pose))
    case = Case(made.filter.belief, latest, [1 / 60] * len(latest), len(latest), cameras=(2,))
    assert monitor._shifted_cameras(case, lasted=100) == shifted


@pytest.mark.parametrize(
    ("shifts", "episode", "fades"),
    [
        ((3.0, 2.8, 2.0, 0.9), 3, True),
        ((3.0, 2.8, 2.0, 0.9), 4, False),  # not over yet
        ((3.0, 2.9, 3.0, 2.8), 3, False),
        ((3.0, 2.8, 2.0, 0.1), 3, False),  # it has passed
    ],
)
def test_an_error_that_fades_when_an_episode_ends_may_pass(shifts: tuple[float, ...], episode: int, fades) -> None:
    made, monitor = steadily(20), monitor_of(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"))
    monitor.filter, monitor._recent = made.filter, made.recent
    monitor.noise.time[:], monitor.noise.lasting[:] = 4.0, 0.05
    monitor.quarantine.add([2], uncertain=False)
    belief = made.filter.belief
    for number, ((observations, pose), shift) in enumerate(zip(made.snapshots[-len(shifts) :], shifts, strict=True), 1):
        uv = observations.uv.clone()
        uv[0, 2, :, 0] += shift
        off = replace(observations, uv=uv)
        if number < len(shifts):
            monitor.quarantine.observe(off, 1 / 60, episode=100)
        else:
            assert monitor._error_fades(belief, 2, _shift(belief, (off, pose), 2), episode) == fades
