"""Sticks and bodies among the lights of a snapshot, by their distances."""

import numpy as np
import pytest
import torch

from imgcal.geometry import rotation_from_vector
from imgcal.online.shape_labels import LightDistances, find_shapes

STICK = np.array([[0.0, 0, 0], [200, 0, 0], [500, 0, 0]])
BODY = np.array([[0.0, 0, 0], [160, 0, 0], [0, 220, 0], [0, 0, 110], [90, 130, 40]])


def put(points: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """An object somewhere, and a moment later."""
    random = np.random.default_rng(seed)
    turn = rotation_from_vector(torch.from_numpy(random.normal(size=3))).numpy()
    now = points @ turn.T + random.uniform(-800, 800, 3)
    later = now @ rotation_from_vector(torch.from_numpy(0.05 * random.normal(size=3))).numpy().T + 8.0
    return now, later


def lights(*objects: tuple[np.ndarray, np.ndarray], noise: float = 0.1) -> LightDistances:
    random, (first, second) = np.random.default_rng(0), (np.concatenate(part) for part in zip(*objects, strict=True))
    count = len(first)
    first, second = (part + noise * random.normal(size=part.shape) for part in (first, second))
    return LightDistances(second, first, np.full((count, count), 2 * noise))


def test_objects_are_found_among_other_lights() -> None:
    others = [put(np.zeros((1, 3)), seed) for seed in range(10, 15)]
    seen = lights(others[0], put(STICK, 1), *others[1:3], put(BODY, 2), *others[3:])
    found = find_shapes([(0, STICK), (3, BODY)], seen)
    assert found.tolist() == [-1, 0, 1, 2, -1, -1, 3, 4, 5, 6, 7, -1, -1]


def test_equal_objects_are_found_in_any_order() -> None:
    seen = lights(put(BODY, 1), put(BODY, 2))
    assert sorted(find_shapes([(0, BODY), (5, BODY)], seen).tolist()) == list(range(10))
    assert find_shapes([(0, BODY)], seen).tolist() == [-1] * 10  # one of them; who knows which


def test_a_hidden_marker_of_a_body_leaves_the_others() -> None:
    whole = lights(put(BODY, 1))
    seen = whole.select(np.array([0, 1, 3, 4]))
    assert find_shapes([(0, BODY)], seen).tolist() == [0, 1, 3, 4]
    assert find_shapes([(0, BODY)], whole.select(np.array([0, 1, 3]))).tolist() == [-1] * 3


def test_lights_that_pass_each_other_are_no_stick() -> None:
    still, pair = put(np.zeros((1, 3)), 1), STICK[:2]
    passing = still[0] + (200.0, 30, 0), still[1] + (200.0, 0, 0)
    assert find_shapes([(0, pair)], lights(still, passing)).tolist() == [-1, -1]
    new = LightDistances(*(lights(put(pair, 1)).place, np.full((2, 3), np.nan), np.full((2, 2), 0.2)))
    assert find_shapes([(0, pair)], new).tolist() == [-1, -1]  # seen for the first time


def test_what_can_be_the_stick_in_two_ways_is_left_out() -> None:
    pair = STICK[:2]
    assert find_shapes([(0, pair)], lights(put(pair, 1), put(pair, 2))).tolist() == [-1] * 4
    bent = np.array([[0.0, 0, 0], [200, 0, 0], [200, 200, 0]])
    assert find_shapes([(0, pair)], lights(put(bent, 1))).tolist() == [-1] * 3
    one_of_body = BODY[[0, 1]]  # the body itself is hidden but for these two
    assert find_shapes([(0, BODY), (5, one_of_body)], lights(put(one_of_body, 1))).tolist() == [-1, -1]


def test_a_mirror_image_is_another_body() -> None:
    assert find_shapes([(0, BODY)], lights(put(BODY * (1, 1, -1), 1))).tolist() == [-1] * 5


@pytest.mark.parametrize(("error", "found"), [(0.2, False), (5.0, True)])
def test_distances_are_as_uncertain_as_the_rig(error: float, found: bool) -> None:
    now, later = put(STICK * 1.01, 1)  # as a rig that is 1 % too large sees it
    number = find_shapes([(0, STICK)], LightDistances(later, now, np.full((3, 3), error)))
    assert (number.tolist() == [0, 1, 2]) is found
