"""The loss against OpenCV's convention of pixels, its masks, and under every transform."""

from dataclasses import replace

import pytest
import torch

from imgcal.nn import ReprojectionLoss
from imgcal.types import Prediction


def scene(rig, poses, drifted, *batch):
    return Prediction(drifted(*batch), poses(*batch)), Prediction(drifted(*batch, seed=1), poses(*batch, seed=1))


def test_is_the_root_mean_square_of_what_the_rig_projects(rig, obj, poses, drifted, batch, device, dtype):
    predicted, truth = scene(rig, poses, drifted, *batch)
    loss = ReprojectionLoss(obj, reduction="none").to(device)
    found = loss(predicted.to(dtype, device), truth.to(dtype, device))
    uv = [p.rig.project(p.rig_from_object.apply(obj.points)).uv for p in (predicted, truth)]
    expected = (uv[0] - uv[1]).square().mean((-3, -2, -1)).sqrt()
    assert found.shape == batch
    assert found.dtype == dtype
    torch.testing.assert_close(found.cpu().double(), expected, rtol=1e-9 if dtype == torch.float64 else 1e-4, atol=0)


def test_reductions(rig, obj, poses, drifted):
    given = scene(rig, poses, drifted, 2, 3)
    each = ReprojectionLoss(obj, "none")(*given)
    torch.testing.assert_close(ReprojectionLoss(obj)(*given), each.mean())
    torch.testing.assert_close(ReprojectionLoss(obj, "sum")(*given), each.sum())
    with pytest.raises(ValueError, match="reduction"):
        ReprojectionLoss(obj, "median")  # type: ignore[arg-type]


def test_what_is_not_seen_does_not_count(rig, obj, poses, drifted):
    predicted, _ = scene(rig, poses, drifted, 3)
    uv = predicted.rig.project(predicted.rig_from_object.apply(obj.points)).uv + 2
    seen = torch.rand(uv.shape[:-1], generator=torch.Generator().manual_seed(0)) > 0.5
    seen[2] = False
    target = torch.where(seen[..., None], uv, torch.nan).requires_grad_()
    loss = ReprojectionLoss(obj, "none")(predicted, target, seen)
    expected = torch.tensor([2.0, 2.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(loss, expected, rtol=0, atol=1e-9)
    (gradient,) = torch.autograd.grad(loss.sum(), target)
    assert gradient.isfinite().all()


def test_other_shapes_are_refused_instead_of_broadcast(rig, obj, poses, drifted):
    predicted, _ = scene(rig, poses, drifted, 3)
    uv = predicted.rig.project(predicted.rig_from_object.apply(obj.points)).uv
    loss, seen = ReprojectionLoss(obj), torch.ones(uv.shape[:-1], dtype=torch.bool)
    assert loss(predicted, uv, seen) < 1e-9
    for wrong in (uv[:, :1], uv[:, :, :1], uv[:1], uv[0], uv[..., :1], torch.tensor(0.0), uv[:, None]):
        with pytest.raises(ValueError, match=r"^target: found shape \("):
            loss(predicted, wrong)
    with pytest.raises(ValueError, match=r"^seen: found shape \(3, 1, "):
        loss(predicted, uv, seen[:, :1])


def test_half_precision_is_computed_in_single(rig, obj, poses, drifted):
    predicted, truth = (p.to(torch.bfloat16) for p in scene(rig, poses, drifted, 2))
    assert ReprojectionLoss(obj)(predicted, truth).dtype == torch.float32


def test_fiducials_behind_cameras_leave_a_finite_gradient(rig, obj, poses, drifted):
    predicted, truth = scene(rig, poses, drifted, 2)
    behind = replace(predicted.rig_from_object, translation=-predicted.rig_from_object.translation).to(torch.float32)
    behind.translation.requires_grad_()
    loss = ReprojectionLoss(obj)(Prediction(predicted.rig.to(torch.float32), behind), truth.to(torch.float32))
    loss.backward()
    assert loss.isfinite()
    assert behind.translation.grad.isfinite().all()


@pytest.mark.parametrize("smaller", [1, 20, 1000])
def test_does_not_depend_on_the_unit_of_length(rig, obj, poses, drifted, smaller):
    def shrink(made):
        cameras = replace(made.rig.cam_from_rig, translation=made.rig.cam_from_rig.translation / smaller)
        small = replace(made.rig, cam_from_rig=cameras, working_distance=made.rig.working_distance / smaller)
        return Prediction(small, replace(made.rig_from_object, translation=made.rig_from_object.translation / smaller))

    radius = None if obj.radius is None else obj.radius / smaller
    predicted, truth = scene(rig, poses, drifted, 3)
    found = ReprojectionLoss(replace(obj, points=obj.points / smaller, radius=radius))(shrink(predicted), shrink(truth))
    torch.testing.assert_close(found, ReprojectionLoss(obj)(predicted, truth))


def test_gradcheck(rig, obj, poses, drifted, batch):
    predicted, truth = scene(rig, poses, drifted, *batch)
    module = ReprojectionLoss(obj, "none")

    def loss(focal_length, translation):
        cameras = replace(predicted.rig, focal_length=focal_length)
        pose = replace(predicted.rig_from_object, translation=translation)
        return module(Prediction(cameras, pose), truth)

    leaves = predicted.rig.focal_length.clone(), predicted.rig_from_object.translation.clone()
    assert torch.autograd.gradcheck(loss, [x.requires_grad_() for x in leaves], check_forward_ad=True)


def test_graphs(rig, obj, poses, drifted, same_in_graphs):
    same_in_graphs(ReprojectionLoss(obj), *scene(rig, poses, drifted, 2))


def test_vmap_and_gradients_by_value_types(rig, obj, poses, drifted):
    predicted, truth = scene(rig, poses, drifted, 3)
    module = ReprojectionLoss(obj)
    each = ReprojectionLoss(obj, "none")(predicted, truth)
    torch.testing.assert_close(torch.func.vmap(module)(predicted, truth), each)
    gradient = torch.func.vmap(torch.func.grad(module))(predicted, truth)
    leaf = predicted.rig.focal_length.clone().requires_grad_()
    cameras = replace(predicted.rig, focal_length=leaf)
    expected = torch.autograd.grad(ReprojectionLoss(obj, "sum")(replace(predicted, rig=cameras), truth), leaf)[0]
    torch.testing.assert_close(gradient.rig.focal_length, expected)
