"""The splatting benchmark runs, and all methods draw the same images and find the same gradients."""

from pathlib import Path

import numpy as np
import pytest
import torch

from renderers import palette, splat_reference
from scripts.benchmarks import splatting
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peers.splats import Scene
from scripts.output import read_json, write_json

SIDE, COUNT = 48, 4
# Largest difference from the reference, and of gradients relative to the largest one.
LIMITS = {
    splatting.OURS_OUT: (1e-6, 1e-5),
    splatting.OURS: (1e-6, 1e-5),
    splatting.DENSE: (1e-3, 1e-2),
    splatting.CIRCLES: (0.6, 0.0),
    splatting.BLUR: (0.04, 0.0),
    splatting.NUMPY: (5e-4, 0.0),
    splatting.WARP_WINDOWS: (5e-4, 1e-3),
    splatting.WARP_PIXELS: (5e-4, 1e-3),
}


def test_runs(tmp_path: Path) -> None:
    write_json(tmp_path / "splatting.json", splatting.measure(Effort(smoke=True)))
    result = read_json(tmp_path / "splatting.json")
    tables = splatting.tables(result)
    assert set(tables) == {"splatting", "splatting rigs", "infrared"}
    assert all(name in tables["splatting"] for name in LIMITS)
    splatting.draw(result, tmp_path / "splatting.png")
    assert (tmp_path / "splatting.png").stat().st_size > 1000


@pytest.mark.parametrize("name", LIMITS)
def test_draws_the_same(name: str) -> None:
    if "Warp" in name:
        pytest.importorskip("warp")
    generator = torch.Generator().manual_seed(1)
    apart = torch.tensor([[12.0, 12.0], [34.0, 12.0], [12.0, 34.0], [34.0, 34.0]])
    uv = apart + 3 * torch.rand(2, COUNT, 2, generator=generator)
    colours, upstream = palette(COUNT), torch.randn(2, 3, SIDE, SIDE, generator=generator)
    make = splatting.cases(Scene(uv.numpy(), colours.numpy(), 2.0, SIDE), upstream.numpy())[name]
    assert make is not None
    leaf = uv.requires_grad_()
    expected = splat_reference(leaf, colours, 2.0, (SIDE, SIDE))
    limit, relative = LIMITS[name]
    case = make()
    for _ in range(2):  # the second time over what the first one left
        assert np.abs(splatting.as_images(case.forward()) - expected.detach().numpy()).max() < limit
        if case.backward is not None:
            (gradient,) = torch.autograd.grad(expected, leaf, upstream, retain_graph=True)
            difference = np.abs(np.asarray(case.backward()) - gradient.numpy()).max()
            assert difference < relative * gradient.abs().max()


def test_memory_counts_what_a_call_holds() -> None:
    grown = splatting.peak_megabytes(lambda: np.ones(2**23))
    assert grown is None or grown == pytest.approx(64, abs=8)
