"""Are predicted errors right for every lens model? Errors of simulated captures relative to their covariance.

Run as `python -m scripts.benchmarks.lenses`; writes docs/benchmarks/lenses.json and its table in the page. Uses four
cameras of each model, and of all three in one rig, with fields of view wide enough for the models to differ. Factory
values drift by their prior, and labels are given. The covariance is the inverse information, so the mean normalized
squared error is one where the estimate reaches the Cramér-Rao bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
import tyro
from torch import Tensor

from imgcal import estimate, load_object, load_rig
from imgcal.estimation import relative_covariance, relative_difference
from imgcal.geometry import RigidTransform, lens_label, lens_width, rotation_from_vector
from imgcal.types import CalibrationObject, CameraRig, Observations, RigPrior
from scripts.benchmarks.effort import Effort
from scripts.output import ROOT, command, fill, markdown, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "lenses.json"
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"
PRIOR = RigPrior(focal_length=0.01, principal_point=5.0, distortion=0.01, rotation=0.005, position=3.0)
NOISE, SNAPSHOTS = 0.1, 12  # px
LENSES = {
    "brown_conrady": (900.0, (-0.2, 0.05, 1e-3, -1e-3, 0.0)),
    "rational": (700.0, (0.5, 0.1, 1e-3, -1e-3, 0.01, 0.8, 0.2, 0.02)),
    "equidistant": (420.0, (0.02, -0.01, 0.003, -0.001)),
}
"""Focal length (px) and coefficients, for images of 1280 x 1024 pixels."""
MIXED = "mixed"
REACH = (500.0, 400.0, 250.0)  # mm, range of the object's positions around the working distance


def rig_of(kind: str) -> CameraRig:
    """Make four cameras with one kind of lens, or with all in turn."""
    rig, size = load_rig("T4"), torch.tensor([1280, 1024])
    names = [kind if kind != MIXED else list(LENSES)[camera % len(LENSES)] for camera in range(rig.num_cameras)]
    models = lens_label(names)
    distortion = torch.zeros(len(names), lens_width(models), dtype=torch.float64)
    for row, name in zip(distortion, names, strict=True):
        row[: len(LENSES[name][1])] = torch.tensor(LENSES[name][1])
    focal = torch.tensor([LENSES[name][0] for name in names], dtype=torch.float64)
    return replace(
        rig,
        focal_length=focal[:, None].expand(-1, 2).contiguous(),
        principal_point=((size - 1) / 2).double().expand(len(names), 2).contiguous(),
        distortion=distortion,
        image_size=size.expand(len(names), 2).contiguous(),
        lens_model=models,
        prior=PRIOR,
        name=kind,
    )


def draw(factory: CameraRig, obj: CalibrationObject, generator: torch.Generator) -> tuple[CameraRig, Observations]:
    """Draw a drifted rig, and its observations of an object at random poses in front of it."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    truth = factory.retract(normal(factory.num_cameras, factory.num_parameters) * PRIOR.std(factory))
    middle = obj.points.new_tensor([0.0, 0.0, factory.working_distance or 0.0])
    many = 40 * SNAPSHOTS
    place = middle + (2 * torch.rand(many, 3, generator=generator, dtype=torch.float64) - 1) * middle.new_tensor(REACH)
    points = RigidTransform(rotation_from_vector(normal(many, 3)), place).apply(obj.points)
    seen = truth.expand(many).project(points)
    enough = ((seen.visible.sum(-1) >= 4).sum(-1) >= 2).nonzero().flatten()[:SNAPSHOTS]
    uv, visible = seen.uv[enough], seen.visible[enough]
    return truth, Observations(uv + NOISE * normal(*uv.shape), torch.full_like(uv[..., 0], NOISE), visible)


def measure(effort: Effort) -> dict[str, Any]:
    """Estimate all captures."""
    torch.set_num_threads(1)
    captures = effort.pick(100, 2)
    result: dict[str, Any] = surroundings() | {"captures": captures, "snapshots": SNAPSHOTS, "rows": []}
    obj = load_object("asymmetric8")
    for number, kind in enumerate((*LENSES, MIXED)):
        factory, generator = rig_of(kind), torch.Generator().manual_seed(number)
        joint, lens, free, converged = [], [], 0, 0
        for _ in range(captures):
            truth, observations = draw(factory, obj, generator)
            found = estimate(observations, factory, obj)
            error = relative_difference(found.rig, truth).flatten()
            covariance = relative_covariance(found)
            std = covariance.diagonal().clamp_min(0).sqrt()
            known = std > 1e-12  # the first camera's pose is exact, and a lens has only its own coefficients
            scaled = (error / std.clamp_min(1e-30))[known]
            correlation = (covariance / (std[:, None] * std))[known][:, known]
            values, vectors = torch.linalg.eigh(correlation)
            along = (vectors.mT @ scaled).square() / values
            joint.append(float(along[values > 1e-9].mean()))
            own = known.view(-1, factory.num_parameters)[:, 10:]
            lens.append(float((error / std.clamp_min(1e-30)).view(own.shape[0], -1)[:, 10:][own].square().mean()))
            free, converged = int(known.sum()), converged + int(found.converged.all())
        row = {"lens": kind, "parameters": free, "converged": converged}
        for name, values_ in (("joint", joint), ("coefficients", lens)):
            column = torch.tensor(values_, dtype=torch.float64)
            row |= {name: float(column.mean()), f"{name}_error": float(column.std()) / len(column) ** 0.5}
        result["rows"].append(row)
    return result


def table(result: dict[str, Any]) -> str:
    """Make the page's table."""
    rows = [
        [
            f"`{row['lens']}`",
            str(row["parameters"]),
            f"{row['converged']} of {result['captures']}",
            *(f"{row[name]:.3f} ± {row[f'{name}_error']:.3f}" for name in ("joint", "coefficients")),
        ]
        for row in result["rows"]
    ]
    return markdown(("lens", "parameters", "converged", "joint NEES", "NEES of the lens coefficients"), rows)


@dataclass(frozen=True)
class Options:
    """Compare errors of estimates with their covariance, for each lens model."""

    smoke: bool = False
    """Run a minimal version to check that it works; write nothing."""


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    result = measure(Effort(options.smoke))
    if not options.smoke:
        write_json(RESULT, result)
        fill(PAGE, {"lenses": table(result)})
    print(table(result))


if __name__ == "__main__":
    command(main)
