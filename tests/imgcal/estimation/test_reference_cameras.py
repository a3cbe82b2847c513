"""Find the cameras that moved when no camera is known to be steady."""

import pytest
import torch

import imgcal
from imgcal.estimation import Gauge, estimate, reference_cameras
from imgcal.estimation.reference_cameras import ALIGNMENTS, ROUNDS, VOTE_SCALE
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import CameraRig, Observations


def turned_as_a_whole(rig: CameraRig) -> CameraRig:
    """Move all cameras together, far."""
    rotation = rotation_from_vector(torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64))
    motion = RigidTransform(rotation, torch.tensor([10.0, 20.0, -30.0], dtype=torch.float64))
    return CameraRig(**{**vars(rig), "cam_from_rig": rig.cam_from_rig @ motion})


@pytest.mark.parametrize("gauge", [Gauge.from_camera(2, 7), Gauge(torch.rand(7, dtype=torch.float64))])
def test_a_motion_of_the_whole_rig_is_no_difference(gauge: Gauge) -> None:
    rig = imgcal.load_rig("U7")
    assert gauge.difference(turned_as_a_whole(rig), rig).abs().max() < 1e-9


@pytest.mark.parametrize("bumped", [0, 3])
def test_the_bumped_camera_is_the_one_that_moved_even_if_it_is_the_first(bumped: int) -> None:
    factory = imgcal.load_rig("U7")
    noise = torch.randn(7, 15, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    units = torch.tensor((1e-5,) * 3 + (0.01,) * 3 + (0.1,) * 4 + (1e-4,) * 5, dtype=torch.float64)
    step = noise * units
    step[bumped, 1] += 0.01  # rad
    found = Gauge.from_majority(*(rig := turned_as_a_whole(factory.retract(step)), factory)).difference(rig, factory)
    assert abs(float(found[bumped, 1]) - 0.01) < 1e-4
    others = [camera for camera in range(7) if camera != bumped]
    assert found[others, :3].abs().max() < 1e-4
    assert found[others, 3:6].abs().max() < 0.1


def test_two_of_five_cameras_do_not_spoil_the_vote() -> None:
    factory = imgcal.load_rig("U7").select(range(5))
    step = torch.zeros(5, 15, dtype=torch.float64)
    step[0, 0], step[4, 4] = 0.02, 15.0
    rig = factory.retract(step)
    found = Gauge.from_majority(rig, factory).difference(rig, factory)
    torch.testing.assert_close(found, step, atol=1e-4, rtol=0)


def test_the_vote_is_that_of_rigs_laid_anew_each_round_at_a_fraction_of_the_work(monkeypatch) -> None:
    factory, generator = imgcal.load_rig("T4").to(torch.float64), torch.Generator().manual_seed(2)
    step = torch.randn(4, 15, generator=generator, dtype=torch.float64)
    rig = turned_as_a_whole(factory.retract(step * torch.tensor((1e-3,) * 3 + (1.0,) * 12, dtype=torch.float64)))
    weights = torch.ones(4, dtype=torch.float64)
    for round_ in range(2 * ROUNDS):
        apart = Gauge(weights).difference(rig, factory)[:, :6] / torch.tensor(VOTE_SCALE, dtype=torch.float64)
        apart = apart.norm(dim=-1)
        weights = 1 / apart if round_ < ROUNDS else 1 / (1 + (apart / apart.median()).square())
        weights = weights / weights.sum()
    moves, average = [], reference_cameras._average
    monkeypatch.setattr(reference_cameras, "_average", lambda *given: (moves.append(1), average(*given))[1])
    torch.testing.assert_close(Gauge.from_majority(rig, factory).weights, weights, rtol=1e-5, atol=1e-9)
    assert len(moves) <= 2 * ALIGNMENTS


def test_a_rig_that_is_aligned_again_and_again_stays_a_rig() -> None:
    """Errors of rounding must not grow: a running rig aligns with what it aligned before."""
    rig = imgcal.load_rig("T4").to(torch.float64)
    step = torch.randn(4, 15, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    now, reference = rig.retract(1e-3 * step), rig
    for _ in range(100):
        reference = Gauge.from_majority(now, reference).align(now, reference)
    rotation = reference.cam_from_rig.rotation
    torch.testing.assert_close(
        rotation @ rotation.mT, torch.eye(3, dtype=rotation.dtype).expand(4, 3, 3), atol=1e-13, rtol=0
    )


@pytest.mark.parametrize(
    "gauge", [Gauge.from_camera(1, 4), Gauge(torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64))]
)
def test_jacobian_is_the_derivative(gauge: Gauge) -> None:
    rig = imgcal.load_rig("T4")

    def difference(step: torch.Tensor) -> torch.Tensor:
        return gauge.difference(rig.retract(step), rig).flatten()

    step = torch.full((4, 15), 1e-9, dtype=torch.float64)
    expected = torch.autograd.functional.jacobian(difference, step).flatten(1)
    torch.testing.assert_close(gauge.jacobian(rig), expected, rtol=1e-5, atol=1e-6)


def test_a_reference_camera_is_known_exactly() -> None:
    rig = imgcal.load_rig("T4")
    std = Gauge.from_camera(1, 4).prior_std(rig, torch.ones(4, 15))
    assert (std[1, :6] == 0).all()
    assert (std[[0, 2, 3]] > 0).all()


def test_standard_deviations_are_those_of_sampled_rigs() -> None:
    rig, gauge = imgcal.load_rig("T4"), Gauge(torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64))
    std = torch.full((4, 15), 1e-3, dtype=torch.float64)
    noise = torch.randn(3000, 4, 15, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sampled = gauge.difference(rig.expand(3000).retract(noise * std), rig).std(0)
    torch.testing.assert_close(sampled, gauge.prior_std(rig, std), rtol=0.06, atol=0)


def test_an_estimate_is_within_its_standard_deviations_of_the_truth() -> None:
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    generator = torch.Generator().manual_seed(5)
    truth = simulate_truth(factory, obj, 6, generator, PhysicalDrift())
    uv = truth.uv + 0.05 * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    seen = torch.ones(uv.shape[:-1], dtype=torch.bool)
    found = estimate(Observations(uv, torch.full(seen.shape, 0.05, dtype=torch.float64), seen), factory, obj)
    gauge = Gauge.from_majority(found.rig, factory)
    normalized = gauge.difference(found.rig, truth.rig) / gauge.std(found)
    assert 0.5 < float(normalized.square().mean()) < 1.8
    assert float(gauge.std(found)[:, 3:6].max()) < 1.5  # mm: without a gauge it is the prior's 10 mm
