"""A bent or different object is reported where its labels look like strays; random strays are not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.monitoring import SHAPE, ObjectChange
from imgcal.online import Event, RigKeeper
from imgcal.online.camera_health import VAIN
from imgcal.online.label_consistency import Checked
from imgcal.online.object_checks import LATEST, ObjectChecks, object_event
from imgcal.types import Detections
from scripts.benchmarks.rig_streams import Conditions, Stream

SINCE = 24


def watched(change: float | tuple[float, float, float], count: int) -> tuple[RigKeeper, torch.Tensor, list[Event], int]:
    """Change the object while it is watched: its scale, or the place (mm) of its third fiducial."""
    obj = imgcal.load_object("asymmetric8")
    made = Stream(imgcal.load_rig("T4"), obj, 5, Conditions(labelled=True))
    points, refused = obj.points.clone(), 0
    events: list[Event] = []
    if isinstance(change, float):
        points = points.mean(0) + change * (points - points.mean(0))
    else:
        points[2] += torch.tensor(change, dtype=points.dtype)
    with RigKeeper(made.factory, obj) as keeper:
        for number in range(count):
            made.obj = replace(obj, points=points) if number >= SINCE else obj
            state = keeper.update(made.snapshot(number), number / 60)
            events += state.events
            refused += state.refused is not None
            assert set(state.cameras.values()) == {"ok" if refused < VAIN or state.refused is None else "doubtful"}
        return keeper, points, events, refused


@pytest.mark.parametrize(
    ("change", "kind", "size"), [((0.9, -0.75, 0.9), "object_bent", 1.48), (1.01, "object_exchanged", 1.0)]
)
def test_an_object_that_is_not_as_its_file_says_is_told_and_learnt(
    change: float | tuple[float, float, float], kind: str, size: float
) -> None:
    keeper, points, (event,), refused = watched(change, SINCE + 30)
    assert (event.kind, event.camera) == (kind, None)
    assert event.size is not None and event.sigma is not None and event.since is not None
    assert abs(event.size - size) < 5 * event.sigma < 0.25 * size
    assert abs(60 * event.since - SINCE) <= 1
    assert refused <= LATEST
    off = keeper.belief.points_object - points
    assert float((off - off.mean(0)).norm(dim=-1).max()) < 0.1


def checked(stray: list[tuple[int, int]]) -> Checked:
    """A snapshot of four cameras and eight fiducials; some labels (camera, fiducial) do not fit."""
    camera, fiducial = np.divmod(np.arange(32), 8)
    zero = np.zeros(32)
    given = Detections(
        np.zeros((32, 2)), zero + 0.1, camera, zero.astype(int), fiducial, zero, zero.astype(np.uint8),
        tuple("abcd"), ("0",),
    )  # fmt: skip
    lost = np.array([(c, n) in stray for c, n in zip(camera.tolist(), fiducial.tolist(), strict=True)])
    left = replace(given, fiducial=np.where(lost, -1, fiducial))
    return Checked(left, given, RigidTransform.identity(1), np.zeros(4, dtype=bool), 0.1, 32 - len(stray))


def test_labels_are_given_back_of_fiducials_that_most_cameras_see_elsewhere() -> None:
    doubts, odd, chance = ObjectChecks(8), [(0, 2), (1, 2), (3, 2)], [(0, 5), (1, 6)]
    asked = []
    for number in range(2 * LATEST):
        now = checked([*odd, *chance])
        asked.append(doubts.observe(now, now.blobs, 1 / 60, number / 60))
    assert asked.index(True) == LATEST - 1
    given = doubts.learnt[-1].blobs
    assert (given.fiducial < 0).sum() == len(chance)
    doubts.record_test(found=False)
    now = checked(odd)
    assert not any(doubts.observe(now, now.blobs, 1 / 60, 1.0) for _ in range(LATEST))  # and again, but not at once
    fits = checked([])
    doubts.observe(fits, fits.blobs, 1 / 60, 2.0)
    assert doubts.odd == {}


def test_what_changed_of_the_object_is_said() -> None:
    told = [object_event(ObjectChange(fiducial, 3, 0.012, 1e-4, 50.0), 1.0, 2.0, 9) for fiducial in (None, SHAPE, 4)]
    assert [(event.kind, event.unit) for event in told] == [
        ("object_exchanged", None), ("object_exchanged", "mm"), ("object_bent", "mm"),
    ]  # fmt: skip
    assert "1.2 % larger" in told[0].message
    assert told[1].message.endswith("0.012 mm (RMS); it was made less accurately, or is a different object")
    assert told[2].message.startswith("fiducial 4 of the object is 0.012 ")
