"""Which of kornia's operations are as good as imgcal's own? Compares values, gradients at singular inputs, and time.

Run as `python -m scripts.benchmarks.kornia_ops`; writes docs/benchmarks/kornia_ops.json and its table in the page. Both
run in turn on one thread, and the best of many calls counts, because other processes only make calls slower. For the
reasons to use an operation of kornia or not, see docs/method.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import tyro
from kornia.filters import gaussian_blur2d
from kornia.geometry import conversions
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import So3
from kornia.geometry.subpix import render_gaussian2d, spatial_expectation2d
from torch import Tensor

from imgcal import load_object, load_rig
from imgcal.geometry import project_components, project_kornia, rotation_from_vector, vector_from_rotation
from imgcal.networks import find_soft_positions
from renderers import splat
from scripts.benchmarks.effort import Effort
from scripts.output import ROOT, command, fill, markdown, surroundings, write_json
from scripts.timing import side_by_side

RESULT = ROOT / "docs" / "benchmarks" / "kornia_ops.json"
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"
RIGS, SIZE = 64, 224

Run = Callable[..., Tensor]


@dataclass(frozen=True)
class Pair:
    """The same operation twice, with the same tensors, for which gradients are taken."""

    name: str
    kornia: str
    inputs: tuple[Tensor, ...]
    ours: Run
    theirs: Run
    unit: str
    special: tuple[Tensor, ...] = ()  # a singular input
    place: str = ""


def pairs() -> list[Pair]:
    """Make all cases, from one seed."""
    random = torch.Generator().manual_seed(0)
    rig, obj = load_rig("O10").to(torch.float32), load_object("asymmetric8")
    away = torch.tensor([0.0, 0.0, float(rig.working_distance or 0)])
    shift = away + 20 * torch.randn(RIGS, 1, 1, 3, generator=random)
    points = rig.cam_from_rig.apply(obj.points.float() + shift)  # (B, C, N, 3)
    lens = (rig.focal_length, rig.principal_point, rig.distortion)
    vectors = torch.randn(RIGS * 10, 3, generator=random)
    rotations = rotation_from_vector(vectors)
    grid = torch.cartesian_prod(*2 * [torch.tensor([40.0, 110.0, 180.0])])[:8]
    uv = grid + 20 * torch.rand(RIGS, 8, 2, generator=random)  # dots apart from each other
    colours, ones = obj.colours.float(), torch.ones(1, 1)
    images = splat(uv, colours, 1.5, (SIZE, SIZE)).clamp(0, 1)

    def project(points: Tensor) -> Tensor:
        return project_components(points.unbind(-1), *lens, rig.image_size).uv

    def pinhole(points: Tensor) -> Tensor:
        inner, outer = (x.expand(RIGS, *x.shape).flatten(0, 1) for x in (intrinsics, torch.eye(4).expand(10, 4, 4)))
        height, width = rig.image_size.float().expand(RIGS, 10, 2).flatten(0, 1).unbind(-1)[::-1]
        return PinholeCamera(inner, outer, height, width).project(points.flatten(0, 1)).view(*points.shape[:-1], 2)

    def ideal(points: Tensor) -> Tensor:
        return project_components(points.unbind(-1), *lens[:2], torch.zeros_like(lens[2]), rig.image_size).uv

    intrinsics = torch.eye(4).repeat(10, 1, 1)
    intrinsics[:, [0, 1], [0, 1]], intrinsics[:, :2, 2] = rig.focal_length, rig.principal_point

    def likeness(images: Tensor) -> Tensor:
        """Dense weights of each fiducial for a soft-argmax: (B, N, H, W), with sum 1."""
        hue = torch.nn.functional.normalize(images, dim=1).movedim(1, -1) @ torch.nn.functional.normalize(colours).mT
        weight = images.amax(1, keepdim=True) * torch.exp((hue.movedim(-1, 1) - 1) / 0.06**2)
        return weight / weight.sum((-2, -1), keepdim=True).clamp_min(1e-12)

    def gaussians(uv: Tensor) -> Tensor:
        """Draw Gaussians of peak 1, summed in one channel."""
        std = torch.full((RIGS * 8, 2), 1.5)
        peak = 2 * math.pi * 1.5**2
        drawn = render_gaussian2d(uv.flatten(0, 1), std, (SIZE, SIZE), False)
        return peak * drawn.view(RIGS, 8, 1, SIZE, SIZE).sum(1)

    def mono(uv: Tensor) -> Tensor:
        return splat(uv, ones.expand(8, 1), 1.5, (SIZE, SIZE))

    def blur(images: Tensor) -> Tensor:
        kernel = torch.exp(-0.5 * (torch.arange(-6, 7) / 2.0) ** 2)
        kernel = (kernel / kernel.sum()).expand(3, 1, -1)
        padded = torch.nn.functional.pad(images, (6, 6, 6, 6), mode="reflect")
        along = torch.nn.functional.conv2d(padded, kernel[:, :, None], groups=3)
        return torch.nn.functional.conv2d(along, kernel[..., None], groups=3)

    none = torch.zeros(1, 3)
    turned = rotation_from_vector(torch.tensor([[math.pi - 1e-3, 0.0, 0.0]]))
    return [
        Pair("distorted pixels", "calibration.distort_points", (points,), project,
             lambda x: project_kornia(x, *lens, rig.image_size).uv, "px"),
        Pair("pixels without distortion", "camera.PinholeCamera.project", (points,), ideal, pinhole, "px"),
        Pair("rotation from a vector", "conversions.axis_angle_to_rotation_matrix", (vectors,), rotation_from_vector,
             conversions.axis_angle_to_rotation_matrix, "1", (none,), "no rotation"),
        Pair("rotation from a vector", "liegroup.So3.exp", (vectors,), rotation_from_vector,
             lambda x: So3.exp(x).matrix(), "1", (none,), "no rotation"),
        Pair("vector from a rotation", "conversions.rotation_matrix_to_axis_angle", (rotations,), vector_from_rotation,
             conversions.rotation_matrix_to_axis_angle, "rad", (turned,), "1e-3 rad before half a turn"),
        Pair("Gaussian dots", "subpix.render_gaussian2d", (uv,), mono, gaussians, "of peak"),
        Pair("places of dots by colour", "subpix.spatial_expectation2d", (images,),
             lambda x: find_soft_positions(x, colours, 1.5)[0],
             lambda x: spatial_expectation2d(likeness(x), normalized_coordinates=False), "px"),
        Pair("blur of images", "filters.gaussian_blur2d", (images[:8],), blur,
             lambda x: gaussian_blur2d(x, (13, 13), (2.0, 2.0)), "1"),
    ]  # fmt: skip


def measure(effort: Effort) -> dict[str, Any]:
    """Compare all pairs."""
    torch.set_num_threads(1)
    result = surroundings() | {"rows": []}
    for pair in pairs():
        leaves = tuple(x.clone().requires_grad_() for x in pair.inputs)
        with torch.no_grad():
            one, other = pair.ours(*pair.inputs), pair.theirs(*pair.inputs)

        def value(run: Run, inputs: tuple[Tensor, ...] = pair.inputs) -> Tensor:
            with torch.no_grad():
                return run(*inputs)

        def gradient(run: Run, leaves: tuple[Tensor, ...] = leaves) -> object:
            found = run(*leaves)
            return torch.autograd.grad(found.sum(), leaves) if found.requires_grad else None

        cases = {
            f"{what} {who}": (lambda work=work, run=run: work(run))
            for what, work in (("value", value), ("gradient", gradient))
            for who, run in (("ours", pair.ours), ("kornia", pair.theirs))
        }
        times = side_by_side(cases, effort.pick(4.0, 0.0))
        result["rows"].append(
            {
                "work": pair.name,
                "kornia": pair.kornia,
                "unit": pair.unit,
                "largest_difference": float((one - other).abs().max()),
                "best_ms": {name: timing.best for name, timing in times.items()},
                "place": pair.place,
                "finite_there": [_finite(run, pair.special) for run in (pair.ours, pair.theirs)]
                if pair.special
                else [],
            }
        )
    return result


def table(result: dict[str, Any]) -> str:
    """Make the page's table."""
    rows = []
    for row in result["rows"]:
        best = row["best_ms"]
        times = [f"{best[f'{what} {who}']:.3g}" for what in ("value", "gradient") for who in ("ours", "kornia")]
        if row["work"].startswith("places"):
            times[2:] = ["not by images", times[3]]
        there = ", ".join("finite" if finite else "not finite" for finite in row["finite_there"])
        hard = f"{row['place']}: {there}" if there else ""
        difference = f"{row['largest_difference']:.1e} {row['unit'] if row['unit'] != '1' else ''}".strip()
        rows.append([row["work"], f"`{row['kornia']}`", difference, *times, hard])
    head = ("ours, ms", "kornia, ms", "ours with gradient, ms", "kornia with gradient, ms")
    return markdown(
        ("work", "kornia", "largest difference", *head, "gradient at the singular input: ours, kornia"), rows
    )


def _finite(run: Run, inputs: tuple[Tensor, ...]) -> bool:
    leaves = tuple(x.clone().requires_grad_() for x in inputs)
    found = run(*leaves)
    return all(bool(x.isfinite().all()) for x in torch.autograd.grad(found.square().sum() + found.sum(), leaves))


@dataclass(frozen=True)
class Options:
    """Compare kornia's operations with imgcal's own."""

    smoke: bool = False
    """Run a minimal version to check that it works; write nothing."""


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    result = measure(Effort(options.smoke))
    if not options.smoke:
        write_json(RESULT, result)
        fill(PAGE, {"kornia ops": table(result)})
    print(table(result))


if __name__ == "__main__":
    command(main)
