import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.estimation import RigUncertainty, pixel_jacobian, rigid_motion, uncertainty_over
from imgcal.estimation.rig_uncertainty import ROUNDS, _best_motion
from imgcal.evaluation.true_error import true_error
from imgcal.geometry import RigidTransform

F64 = torch.float64


@pytest.fixture(scope="module")
def rig(o10):
    return o10.select([0, 3, 7])


@pytest.fixture(scope="module")
def points():
    generator = torch.Generator().manual_seed(0)
    return 100 * torch.randn(40, 3, generator=generator, dtype=F64) + torch.tensor([0.0, 0.0, 850.0], dtype=F64)


def covariance_of(rig, scale=1e-3, seed=0):
    """A full, correlated covariance, small enough for first order."""
    factor = torch.randn(15 * rig.num_cameras, 60, generator=torch.Generator().manual_seed(seed), dtype=F64)
    unit = torch.tensor([1e-3] * 3 + [1.0] * 3 + [2.0] * 4 + [2e-3] * 5, dtype=F64).repeat(rig.num_cameras)
    factor = scale * unit[:, None] * factor
    return factor @ factor.mT, factor


def test_derivatives_are_those_of_the_projection(rig, points):
    zero = torch.zeros(3, 15, dtype=F64)
    every = torch.func.jacrev(lambda step: rig.retract(step).project(points).uv)(zero)  # (C, P, 2, C, 15)
    own = torch.stack([every[c, :, :, c] for c in range(3)])
    torch.testing.assert_close(pixel_jacobian(rig, points), own, rtol=1e-9, atol=1e-9)


def test_each_camera_may_have_points_of_its_own(rig, points):
    apart = torch.stack((points, points + 5, points - 9))
    every = pixel_jacobian(rig, apart)
    for camera in range(3):
        one = pixel_jacobian(rig.select([camera]), apart[camera])
        torch.testing.assert_close(every[camera], one[0])


def test_points_that_move_with_the_rig_keep_their_pixels(rig, points):
    motion = torch.tensor([1e-6, -2e-6, 3e-6, 1e-3, 2e-3, -1e-3], dtype=F64)
    centre = points.mean(0)
    moved = rig.retract((rigid_motion(rig, centre) @ motion).view(3, 15))
    along = points + torch.linalg.cross(motion[:3].expand_as(points), points - centre) + motion[3:]
    torch.testing.assert_close(moved.project(along).uv, rig.project(points).uv, rtol=0, atol=1e-7)
    assert (moved.project(points).uv - rig.project(points).uv).abs().max() > 1e-4


def test_a_motion_of_the_whole_rig_does_not_count(rig, points):
    covariance, _ = covariance_of(rig)
    motion = rigid_motion(rig, points.mean(0))
    unknown = covariance + motion @ torch.diag(torch.tensor([1e-4] * 3 + [100.0] * 3, dtype=F64)) @ motion.mT
    seen = torch.ones(3, len(points), dtype=torch.bool)
    first, second = (uncertainty_over(rig, c, points) for c in (covariance, unknown))
    torch.testing.assert_close(first.pixel_error(points), second.pixel_error(points), rtol=1e-5, atol=0)
    torch.testing.assert_close(first.point_error(points, seen), second.point_error(points, seen), rtol=1e-5, atol=0)
    # What is known of nothing but the gauge is no error at all.
    gauge = uncertainty_over(rig, motion @ motion.mT, points)
    assert gauge.pixel_error(points).max() < 1e-4 * (motion @ motion.mT).diagonal().sqrt().max()


def test_sampled_rigs_scatter_as_predicted(rig, points):
    covariance, factor = covariance_of(rig)
    found = uncertainty_over(rig, covariance, points)
    held_out = points[:10] + 20
    seen = torch.ones(3, 10, dtype=torch.bool)
    generator = torch.Generator().manual_seed(1)
    squares = [torch.zeros(3, 10, dtype=F64), torch.zeros(10, dtype=F64)]
    shift = RigidTransform(torch.eye(3, dtype=F64)[None], torch.tensor([[30.0, -5.0, 8.0]], dtype=F64))
    for _ in range(120):
        truth = rig.retract((factor @ torch.randn(60, generator=generator, dtype=F64)).view(3, 15))
        # The true rig may stand anywhere.
        truth = type(truth)(**(vars(truth) | {"cam_from_rig": truth.cam_from_rig @ shift}))
        for total, error in zip(squares, true_error(found, truth, held_out), strict=True):
            total += error.square() / 120
    predicted = (found.pixel_error(held_out), found.point_error(held_out, seen))
    for total, error in zip(squares, predicted, strict=True):
        torch.testing.assert_close(total.sqrt(), error, rtol=0.25, atol=0)
        assert (total / error.square()).mean().sqrt() == pytest.approx(1, abs=0.07)


def test_one_bad_camera_does_not_spoil_the_others(o10, points):
    rig = o10.select(range(6))
    covariance, _ = covariance_of(rig, 1e-4)
    good = uncertainty_over(rig, covariance, points).pixel_error(points)
    bad = covariance.clone()
    bad[30:45, 30:45] += torch.diag(torch.tensor([1e-2] * 3 + [10.0] * 3 + [20.0] * 4 + [0.01] * 5, dtype=F64)) ** 2
    error = uncertainty_over(rig, bad, points).pixel_error(points).median(dim=1).values
    assert error[2] > 5
    others = [0, 1, 3, 4, 5]
    assert (error[others] < 1.5 * good.median(dim=1).values[others]).all()


def test_noise_of_the_pixels_adds_to_triangulated_points(rig, points):
    found = uncertainty_over(rig, covariance_of(rig)[0], points)
    seen = torch.ones(3, len(points), dtype=torch.bool)
    alone, with_noise = found.point_error(points, seen), found.point_error(points, seen, 0.5)
    rows = -pixel_jacobian(rig, points[:1])[:, 0, :, 3:6].flatten(0, 1)
    scatter = 0.5 * torch.linalg.pinv(rows).square().sum().sqrt()
    assert (with_noise.square() - alone.square()).sqrt()[0] == pytest.approx(float(scatter))


def aligned_covariance(covariance, motion, metric):
    """Project a covariance (K, K) onto the complement of the rigid motions (K, 6) in a metric (K, K), in full size."""
    keep = torch.eye(len(covariance), dtype=F64) - motion @ _best_motion(motion, metric @ motion)
    return keep @ covariance @ keep.mT


def test_points_of_one_camera_have_no_place(rig, points):
    found = uncertainty_over(rig, covariance_of(rig)[0], points)
    seen = torch.ones(3, len(points), dtype=torch.bool)
    seen[1:, 4] = False
    assert found.point_error(points, seen).isnan().nonzero().squeeze(-1).tolist() == [4]


def test_nothing_in_view_says_nothing(rig, points):
    covariance, _ = covariance_of(rig)
    behind = points - torch.tensor([0.0, 0.0, 2000.0], dtype=F64)
    found = uncertainty_over(rig, covariance, behind)
    assert found.pixel_error(points).isnan().all()
    assert found.point_error(points, torch.ones(3, len(points), dtype=torch.bool)).isnan().all()
    motion = rigid_motion(rig, points.mean(0))
    with pytest.raises(RefusedError, match="see too little of the working volume"):
        aligned_covariance(covariance, motion, torch.zeros_like(covariance))


def test_all_errors_in_one_pass_are_those_of_each(rig, points):
    found = uncertainty_over(rig, covariance_of(rig)[0], points)
    seen = torch.ones(3, len(points), dtype=torch.bool)
    seen[0, :7] = seen[1, 3] = seen[2, 5:20] = False
    expected = (found.pixel_error(points), found.point_error(points, seen), found.point_error(points, seen, 0.3))
    for one, other in zip(found.errors(points, seen, 0.3), expected, strict=True):
        torch.testing.assert_close(one, other, equal_nan=True)


def test_alignment_in_six_dimensions_is_that_of_the_whole_covariance(o10, points):
    rig = o10.select(range(5))
    covariance, _ = covariance_of(rig, 1e-4)
    covariance[30:45, 30:45] *= 25
    points = points * torch.tensor([3.0, 2.0, 1.0], dtype=F64)  # some of them outside of images
    points = points[rig.project(points).visible.sum(0) >= 2]
    seen = rig.project(points).visible
    assert not seen.all() and seen.sum(0).min() >= 2
    motion, pixels = rigid_motion(rig, points.mean(0)), pixel_jacobian(rig, points)
    px_weight, mm_weight = seen.to(points), torch.ones(len(points), dtype=F64)
    by_point = -pixels[..., 3:6] * seen[..., None, None]
    inverse = torch.linalg.inv(torch.einsum("cpri,cprj->pij", by_point, by_point))
    response = torch.einsum("pij,cprj,cprk->pick", inverse, by_point, pixels).flatten(2)  # (P, 3, K C)

    def aligned(px_weight, mm_weight):
        px_metric = torch.block_diag(*torch.einsum("cprk,cprl,cp->ckl", pixels, pixels, px_weight))
        mm_metric = torch.einsum("pik,pil,p->kl", response, response, mm_weight)
        parts = (aligned_covariance(covariance, motion, metric) for metric in (px_metric, mm_metric))
        return RigUncertainty(rig, covariance, points, px_weight, mm_weight, *parts)

    plain = aligned(px_weight, mm_weight)
    for _ in range(ROUNDS - 1):
        errors = plain.pixel_error(points), plain.point_error(points, seen)
        medians = errors[0][seen].median(), errors[1].median()
        px_weight, mm_weight = ((m / e).clamp_max(1).square() for m, e in zip(medians, errors, strict=True))
        plain = aligned(px_weight * seen, mm_weight)
    found = uncertainty_over(rig, covariance, points)
    assert (px_weight < 1).any() and (mm_weight < 1).any()
    torch.testing.assert_close(found.px_weight, plain.px_weight)
    torch.testing.assert_close(found.mm_weight, plain.mm_weight)
    for one, other in ((found.px_covariance, plain.px_covariance), (found.mm_covariance, plain.mm_covariance)):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9 * float(other.abs().max()))
