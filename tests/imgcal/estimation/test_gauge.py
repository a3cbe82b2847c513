import torch

from imgcal.estimation import align
from imgcal.geometry import RigidTransform, rotation_from_vector


def test_a_motion_of_the_whole_rig_is_taken_out(o10, asymmetric8):
    there = RigidTransform(
        rotation_from_vector(torch.tensor([[0.01, -0.02, 0.005]], dtype=torch.float64)),
        torch.tensor([[5.0, -8.0, 3.0]], dtype=torch.float64),
    )
    step = torch.zeros(10, 15, dtype=torch.float64)
    step[3, 1], step[6, 4] = 0.05, 20.0  # two cameras have moved by themselves
    other = o10.retract(step)
    other = other.__class__(**{**vars(other), "cam_from_rig": other.cam_from_rig @ there})
    points = asymmetric8.points + torch.tensor([0.0, 0.0, 800.0], dtype=torch.float64)
    back = align(other, o10, points, [0, 1, 2, 3, 4, 5])
    rest = [c for c in range(10) if c not in (3, 6)]
    assert (back.select(rest).project(points).uv - o10.select(rest).project(points).uv).abs().max() < 0.05
    assert torch.allclose(back.local(o10)[6, 3:6], step[6, 3:6], atol=0.1)


def test_without_common_cameras_nothing_is_moved(o10, asymmetric8):
    assert align(o10, o10, asymmetric8.points, []) is o10
