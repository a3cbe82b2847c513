"""Devices, types and scenes for the tests of modules: four cameras, eight fiducials, batches of other lengths."""

import shutil
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import read_rig
from imgcal.types import CalibrationObject, CameraRig, RigPrior


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Every device that is there; the others are skipped, visibly."""
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return torch.device(request.param)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    """Both types that everything runs in."""
    return request.param


@pytest.fixture(params=[(), (1,), (2, 3)], ids=str)
def batch(request: pytest.FixtureRequest) -> tuple[int, ...]:
    """Batch axes."""
    return request.param


@pytest.fixture(scope="session")
def rig() -> CameraRig:
    """Four cameras, float64."""
    return read_rig("T4")


@pytest.fixture(scope="session")
def obj(asymmetric8: CalibrationObject) -> CalibrationObject:
    """Eight fiducials, float64."""
    return asymmetric8


@pytest.fixture(scope="session")
def poses(rig: CameraRig) -> Callable[..., RigidTransform]:
    """Draw (*B) poses near the working distance, float64."""

    def draw(*batch: int, seed: int = 0) -> RigidTransform:
        random = torch.Generator().manual_seed(seed)
        turn, shift = torch.randn(2, *batch, 3, generator=random, dtype=torch.float64)
        away = torch.tensor([0.0, 0.0, rig.working_distance], dtype=torch.float64)
        return RigidTransform(rotation_from_vector(0.3 * turn), 20 * shift + away)

    return draw


@pytest.fixture(scope="session")
def drifted(rig: CameraRig) -> Callable[..., CameraRig]:
    """Draw (*B) rigs, a third of what is usual off, float64."""

    def draw(*batch: int, seed: int = 0, rig: CameraRig = rig) -> CameraRig:
        random = torch.Generator().manual_seed(seed)
        std = RigPrior().std(rig)
        return rig.expand(*batch).retract(
            0.3 * torch.randn(*batch, *std.shape, generator=random, dtype=std.dtype) * std
        )

    return draw


@pytest.fixture(scope="session")
def compiler() -> str:
    """A C++ compiler for PyTorch's own backend; tests that need it are skipped, visibly, without one."""
    found = shutil.which("g++") or shutil.which("clang++")
    if found is None:
        pytest.skip("no C++ compiler")
    return found


@pytest.fixture(scope="session")
def same_in_graphs() -> Callable[..., None]:
    """Check that a module does in one compiled graph, and exported, what it does in eager code."""

    def check(module: nn.Module, *inputs: Any, tolerance: float = 1e-9) -> None:
        expected = leaves(module(*inputs))
        compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
        exported = torch.export.export(module, inputs, strict=False).module()
        for found in (compiled(*inputs), exported(*inputs)):
            torch.testing.assert_close(leaves(found), expected, rtol=tolerance, atol=tolerance)

    return check


def leaves(tree: Any) -> list[Tensor]:
    return [x for x in torch.utils._pytree.tree_leaves(tree) if isinstance(x, Tensor)]
