import numpy as np
import pytest

from imgcal.formats.chains import Link, compose, follow_links, inverse, pose_from_matrix
from imgcal.formats.foreign_rig import FormatError
from imgcal.formats.values import rotation_from_vector

DRAW = np.random.default_rng(2)


def pose() -> tuple[np.ndarray, np.ndarray]:
    return rotation_from_vector(DRAW.normal(size=3)), DRAW.normal(size=3)


def test_links_are_followed_in_both_directions() -> None:
    b_from_a, c_from_b, d_from_a = pose(), pose(), pose()
    links = [Link("b", "a", b_from_a), Link("c", "b", c_from_b), Link("a", "d", inverse(d_from_a))]
    found = follow_links("a", ["a", "b", "c", "d"], links)
    for name, expected in {"c": compose(c_from_b, b_from_a), "d": d_from_a}.items():
        assert all(np.allclose(x, y) for x, y in zip(found[name], expected, strict=True))


def test_who_is_not_linked_is_named() -> None:
    with pytest.raises(FormatError, match="cameras c, d: no pose relative to a"):
        follow_links("a", ["a", "b", "c", "d"], [Link("b", "a", pose()), Link("d", "c", pose())])


def test_a_matrix_has_its_last_row() -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = 1, 2, 3
    assert pose_from_matrix(matrix, "T")[1].tolist() == [1, 2, 3]
    with pytest.raises(FormatError, match="last row"):
        pose_from_matrix(matrix.T, "T")
