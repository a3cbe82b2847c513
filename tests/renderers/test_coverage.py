"""Uneven, cut and smeared blobs against brute force."""

import math

import pytest
import torch

from renderers import Smear, Spots, Surface, render_blobs
from renderers.reference import blob_reference

DTYPE = torch.float64
WHOLE = torch.tensor([[[1.0, 0.0, math.inf]]], dtype=DTYPE)
EVEN = {"path": (0.0, 0.0), "defocus": 0.0}
DISC, TILTED = [[36.0, 0.0], [0.0, 36.0]], [[30.0, 9.0], [9.0, 16.0]]


def tensor(values):
    return torch.tensor(values, dtype=DTYPE)


def blob(shape=DISC, surface=None, smear=None, at=(22.3, 19.8)):
    one = torch.ones(1, dtype=DTYPE)
    return Spots(tensor([at]), tensor([shape]), one, one > 0, one, surface, smear)


def smear(path=(0.0, 0.0), defocus=0.0):
    return Smear(tensor([path]), tensor([defocus]))


def half(angle, offset):
    return Surface(tensor([[[math.cos(angle), math.sin(angle), offset]]]))


def centroid(frame):
    v, u = (torch.arange(n, dtype=DTYPE) for n in frame.shape)
    return torch.stack([frame.sum(0) @ u, frame.sum(1) @ v]) / frame.sum()


BLOBS = {
    "moving": blob(smear=smear(path=(9.0, -4.0))),
    "moving fast": blob(shape=[[4.0, 0.0], [0.0, 4.0]], smear=smear(path=(-18.0, 11.0))),
    "out of focus": blob(shape=TILTED, smear=smear(defocus=4.0)),
    "moving and out of focus": blob(shape=TILTED, smear=smear((5.0, 5.0), 3.0)),
    "half hidden from the side": blob(surface=half(0.0, 1.0)),
    "half hidden from above": blob(surface=half(-1.2, 0.5)),
    "half hidden askew": blob(shape=TILTED, surface=half(2.2, -1.5)),
    "in a wedge": blob(surface=Surface(tensor([[[1.0, 0.0, 2.0], [0.6, 0.8, 1.0]]]))),
    "dark at the limb": blob(surface=Surface(WHOLE, limb=tensor([0.7]))),
    "dirty": blob(TILTED, Surface(WHOLE, None, tensor([[[0.3, -0.4, 0.25, -0.9], [-0.5, 0.2, 0.4, 0.8]]]))),
    "everything": blob(
        TILTED, Surface(half(0.4, 1.0).cuts, tensor([0.5]), tensor([[[0.2, 0.3, 0.4, -0.6]]])), smear((6.0, 3.0), 2.0)
    ),
}  # fmt: skip

TWICE = ("moving and out of focus", "everything")


@pytest.mark.parametrize("name", BLOBS)
def test_blobs_equal_brute_force(name):
    spot = BLOBS[name]
    light, _ = render_blobs(spot, (40, 45), 0.8)
    # Where the light is spread, the pictures of brute force may be coarse, and there are many of them.
    samples, moments = (12, 1) if spot.smear is None else (4, 8) if name in TWICE else (4, 48)
    expected = blob_reference(spot, (40, 45), blur=0.8, samples=samples, moments=moments)
    assert light.sum().item() == pytest.approx(expected.sum().item(), rel=0.012)
    assert (centroid(light) - centroid(expected)).abs().max() < 0.035  # an edge is placed to within a slab
    torch.testing.assert_close(light, expected, atol=0.02, rtol=0)


@pytest.mark.parametrize("blur", [0.2, 0.4, 0.7, 1.5])
def test_smearing_moves_no_light(blur):
    """Of a disc: the integral is its area and the centroid its centre, whatever it is smeared over."""
    spot = blob(smear=smear((7.3, -5.1), 2.6))
    light, seen = render_blobs(spot, (40, 45), blur)
    assert light.sum().item() == pytest.approx(36 * math.pi, rel=1e-4)
    assert seen.item() == pytest.approx(1.0, abs=1e-4)
    assert (centroid(light) - spot.uv[0]).abs().max() < 1e-3


def test_what_is_smeared_over_the_border_does_not_come_back():
    spot = blob(smear=smear((14.0, 0.0), 2.0), at=(1.0, 19.8))
    light, seen = render_blobs(spot, (40, 45), 0.7)
    wide, _ = render_blobs(blob(smear=smear((14.0, 0.0), 2.0), at=(31.0, 19.8)), (40, 75), 0.7)
    torch.testing.assert_close(light[:, :45], wide[:, 30:75], atol=1e-6, rtol=0)
    assert 0.4 < seen.item() < 0.7


def test_a_cut_leaves_its_share():
    for offset, share in ((0.0, 0.5), (6.0, 1.0), (-6.0, 0.0), (math.inf, 1.0)):
        _, seen = render_blobs(blob(surface=half(0.7, offset)), (40, 45), 0.7)
        assert seen.item() == pytest.approx(share, abs=2e-3)


def test_gradients_of_a_cut_moving_blob():
    at, path, shape = (tensor(x).requires_grad_() for x in ([[9.3, 8.1]], [[3.0, 1.0]], [[[7.0, 1.0], [1.0, 5.0]]]))
    surface = Surface(half(0.4, 1.0).cuts, tensor([0.5]), None)

    def render(at, path, shape):
        one = torch.ones(1, dtype=DTYPE)
        return render_blobs(Spots(at, shape, one, one > 0, one, surface, Smear(path, 0 * one)), (18, 20), 0.7)[0]

    assert torch.autograd.gradcheck(render, (at, path, shape), fast_mode=True)


def test_a_known_extent_changes_nothing():
    spot = BLOBS["everything"]
    torch.testing.assert_close(
        render_blobs(spot, (40, 45), 0.8, extent=(6.0, 20.0)), render_blobs(spot, (40, 45), 0.8), atol=3e-4, rtol=0
    )
