"""The module against the function, and under every transform."""

from dataclasses import replace

import torch

from imgcal.geometry import RigidTransform
from imgcal.nn import ProjectRig


def test_projects_what_the_rig_does(rig, obj, poses, batch, device, dtype):
    pose = poses(*batch)
    module = ProjectRig(obj).to(device)
    found = module(rig.to(dtype, device), pose.to(dtype, device))
    expected = rig.project(pose.apply(obj.points))
    assert found.uv.shape == (*batch, 4, 8, 2)
    assert found.uv.dtype == dtype
    assert found.uv.device.type == device.type
    assert torch.equal(found.visible.cpu(), expected.visible)
    torch.testing.assert_close(
        found.uv.cpu().double(), expected.uv, rtol=0, atol=1e-9 if dtype == torch.float64 else 0.01
    )


def test_without_pose_the_rig_is_in_the_frame_of_the_object(rig, obj, poses):
    pose = poses(2)
    module = ProjectRig(obj)
    torch.testing.assert_close(module(rig.from_object(pose)).uv, module(rig, pose).uv)


def test_radii_are_projected_as_apparent_centres(rig, obj, poses):
    spheres = replace(obj, radius=torch.full((8,), 6.0, dtype=torch.float64))
    pose = poses()
    expected = rig.project(pose.apply(obj.points), spheres.radius).uv
    torch.testing.assert_close(ProjectRig(spheres)(rig, pose).uv, expected)


def test_gradcheck(rig, obj, poses, drifted, batch):
    pose, cameras = poses(*batch), drifted(*batch)
    module = ProjectRig(obj)

    def uv(focal_length, distortion, rotation, translation):
        moved = replace(cameras, focal_length=focal_length, distortion=distortion)
        return module(moved, RigidTransform(rotation, translation)).uv

    leaves = (cameras.focal_length, cameras.distortion, pose.rotation, pose.translation)
    assert torch.autograd.gradcheck(
        uv, [x.clone().requires_grad_() for x in leaves], check_forward_ad=True, fast_mode=True, atol=1e-4
    )


def test_graphs(rig, obj, poses, drifted, same_in_graphs):
    same_in_graphs(ProjectRig(obj), drifted(2), poses(2))


def test_vmap_and_jacobians_take_value_types(rig, obj, poses, drifted):
    module, cameras, pose = ProjectRig(obj), drifted(3), poses(3)
    torch.testing.assert_close(torch.func.vmap(module)(cameras, pose).uv, module(cameras, pose).uv)

    def uv(cameras, pose):
        return module(cameras, pose).uv

    forward = torch.func.jacfwd(uv, argnums=(0, 1))(cameras[0], pose[0])
    backward = torch.func.jacrev(uv, argnums=(0, 1))(cameras[0], pose[0])
    for one, other in zip(*map(torch.utils._pytree.tree_leaves, (forward, backward)), strict=True):
        torch.testing.assert_close(one, other)


def test_buffers_move_with_the_module_and_are_not_saved(obj):
    module = ProjectRig(obj).float()
    assert module.obj.points.dtype == torch.float32
    assert module.state_dict() == {}
