"""Turns that nothing of an object shows."""

import pytest
import torch

from imgcal.geometry import free_turns, pose_rank

LINE = torch.tensor([[-2.0, -4.0, 4.0], [1.0, 2.0, -2.0], [1.0, 2.0, -2.0]], dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_line_turns_about_itself_alone(dtype: torch.dtype) -> None:
    turns = free_turns(LINE.to(dtype))
    axis = torch.tensor([1.0, 2.0, -2.0], dtype=dtype) / 3
    torch.testing.assert_close(turns, axis[:, None] * axis)
    assert pose_rank(LINE.to(dtype) + 700.0) == 5


def test_a_point_turns_as_it_likes_and_a_plane_not_at_all() -> None:
    assert bool((free_turns(torch.zeros(1, 3)) == torch.eye(3)).all())
    plane = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 0.01, 0]])
    assert not bool(free_turns(plane).any()) and pose_rank(plane) == 6
