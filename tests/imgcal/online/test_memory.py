"""Values to JSON and back, exactly."""

import json
import math
from collections import deque

import numpy as np
import pytest
import torch

from imgcal.geometry import RigidTransform
from imgcal.online.memory import Frozen, Thawed


def back(value):
    return Thawed(json.loads(json.dumps(Frozen(value).plain(), allow_nan=False))).value


def test_values_come_back_exactly() -> None:
    pose = RigidTransform(torch.eye(3).double() / 3, torch.tensor([0.1, math.pi, -0.0]).double())
    value = {
        "numbers": [1, 0.1, True, None, "text", math.inf, (2, 3)],
        3: deque([np.arange(6.0).reshape(2, 3).T, np.array([True, False])], maxlen=5),
        "pose": pose,
        "again": pose,
        "set": {3, 1},
    }
    found = back(value)
    assert found["numbers"] == value["numbers"]
    assert found["set"] == {3, 1}
    assert found["again"] is found["pose"]
    assert torch.equal(found["pose"].rotation, pose.rotation)
    assert torch.signbit(found["pose"].translation[2])
    assert found[3].maxlen == 5
    assert found[3][0].flags.f_contiguous
    np.testing.assert_array_equal(found[3][0], value[3][0])
    assert math.isnan(back(math.nan))


def test_what_changes_later_is_kept_as_it_was() -> None:
    array = np.zeros(3)
    frozen = Frozen([array])
    array[:] = 1.0
    np.testing.assert_array_equal(Thawed(frozen.plain()).value[0], np.zeros(3))


def test_objects_of_other_classes_are_not_saved() -> None:
    with pytest.raises(TypeError, match="cannot be saved"):
        Frozen([object()])


@pytest.mark.parametrize(
    "plain",
    [
        {"of": "os:system", "values": {}},
        {"of": "imgcal.geometry.transforms:RigidTransform", "values": {"rotation": None}},
        {"array": ["float64", [-1], "", False]},
        {"array": ["float64", [2], "AAAA", False]},
        {"array": ["object", [0], "", False]},
        {"array": ["bool", [1], "Bw==", False]},
        {"again": 7},
        {"deque": [], "most": 10**12},
        {"float": "1"},
        {"list": 3},
        [1],
    ],
)
def test_nonsense_is_refused(plain) -> None:
    with pytest.raises(ValueError):
        Thawed(plain)
