"""Projection and distortion: one camera with many points, batches of rigs, derivatives, and synthesis of rigs."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from imgcal.estimation import Problem, State, levenberg_marquardt_cpu
from imgcal.geometry import RigidTransform, project_kornia
from imgcal.io import load_object, read_rig
from imgcal.synthesis import synthesize
from imgcal.types import CameraRig
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peer import versions
from scripts.benchmarks.peers import projections as peers
from scripts.benchmarks.peers.projections import Run, Views
from scripts.output import BLUE, GREY, figure, markdown
from scripts.timing import side_by_side

POINTS = (1_000, 10_000, 100_000, 1_000_000, 10_000_000)  # in one camera
RIGS = (1, 64, 512, 4096)  # with 10 cameras and 8 fiducials
DERIVATIVES = (("camera", 10_000), ("rigs", 64), ("rigs", 512))
OURS, OURS_SINGLE = "**imgcal**", "**imgcal**, float32"
TENSORS, OURS_KORNIA = "imgcal's tensors, any device", "imgcal's kornia path"
KORNIA, OPENCV, COLMAP = "kornia `PinholeCamera`, `distort_points`", "`cv2.projectPoints`", "pycolmap `img_from_cam`"
NUMPY = "NumPy"
EQUATIONS, AUTOGRAD = "**imgcal**: compiled normal equations", "imgcal's tensors, autograd"
COMPUTES = {
    EQUATIONS: "Jacobian by camera and pose, its products",
    AUTOGRAD: "one gradient, also by points",
    KORNIA: "one gradient, also by points",
    OPENCV: "Jacobian by camera",
}
OBSERVED = slice(6, 15)  # focal length, principal point, distortion: the same in all parametrizations


@dataclass(frozen=True)
class Scene:
    """Cameras and points in front of them, in float64."""

    rig: CameraRig  # (B,)
    rig_from_object: RigidTransform  # (B,)
    points_object: Tensor  # (N, 3) mm

    @property
    def points(self) -> Tensor:
        """(B, N, 3) mm in the rig's frame."""
        return self.rig_from_object.apply(self.points_object).contiguous()

    @property
    def views(self) -> Views:
        """The same as arrays."""
        rig, transform = self.rig, self.rig.cam_from_rig
        width, height = rig.image_size[0].tolist()
        return Views(
            points=self.points.numpy(),
            rotation=transform.rotation.numpy(),
            translation=transform.translation.numpy(),
            focal_length=rig.focal_length.numpy(),
            principal_point=rig.principal_point.numpy(),
            distortion=rig.distortion.numpy(),
            image_size=(width, height),
        )


def measure(effort: Effort) -> dict[str, Any]:
    """Time all tools on the same points."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    sizes = [("camera", n) for n in effort.pick(POINTS, (50,))] + [("rigs", n) for n in effort.pick(RIGS, (2,))]
    derivatives = effort.pick(DERIVATIVES, (("camera", 30), ("rigs", 2)))
    return {
        "versions": versions("opencv-python-headless", "pycolmap", "kornia", "numpy", "numba"),
        "shapes": [_measure_values(kind, count, effort) for kind, count in sizes],
        "derivatives": [_measure_derivatives(kind, count, effort) for kind, count in derivatives],
        "synthesis": _measure_synthesis(effort),
    }


def scene_of(kind: str, count: int) -> Scene:
    """Return one camera with `count` points, or `count` drifted O10 rigs with 8 fiducials each."""
    generator = torch.Generator().manual_seed(0)
    rig, obj = read_rig("O10"), load_object("asymmetric8")
    if kind == "rigs":
        made = synthesize(rig, obj, count, generator)
        return Scene(made.rig, made.rig_from_object, obj.points)
    made = synthesize(rig, obj, 1, generator)
    points = 160 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 80
    return Scene(made.rig.select([0]), made.rig_from_object, points)


def value_cases(scene: Scene) -> dict[str, Run | None]:
    """Functions that project; None = the tool is absent. Each returns (B, C, N, 2)."""
    rig, points, views = scene.rig, scene.points, scene.views
    single, few = rig.to(torch.float32), points.float()
    lens = (rig.focal_length, rig.principal_point, rig.distortion, rig.image_size)
    return {
        OURS: lambda: rig.project_values(points).uv,
        OURS_SINGLE: lambda: single.project_values(few).uv,
        TENSORS: lambda: rig.project(points).uv,
        OURS_KORNIA: lambda: project_kornia(rig.cam_from_rig.apply(points[:, None]), *lens).uv,
        KORNIA: peers.kornia_camera(views),
        OPENCV: peers.opencv(views),
        COLMAP: peers.pycolmap_cameras(views),
        NUMPY: peers.numpy_arrays(views),
    }


def derivative_cases(scene: Scene, upstream: Tensor) -> dict[str, tuple[Run, Callable[[Any], np.ndarray]]]:
    """Functions to time, each with one that extracts upstream (B, C, N, 2) times J (B * C, 9) from its result."""
    views, pull = scene.views, upstream.numpy()
    rig = scene.rig
    inputs = (rig.focal_length, rig.principal_point, rig.distortion, rig.cam_from_rig.rotation)
    leaves = [x.clone().requires_grad_() for x in (*inputs, rig.cam_from_rig.translation, scene.points)]

    def autograd() -> tuple[Tensor, ...]:
        focal, principal, distortion, rotation, translation, points = leaves
        transform = RigidTransform(rotation, translation)
        made = replace(
            rig, focal_length=focal, principal_point=principal, distortion=distortion, cam_from_rig=transform
        )
        return torch.autograd.grad(made.project(points).uv, leaves, upstream)

    def of_kornia(found: tuple[Tensor, ...]) -> np.ndarray:
        by_matrix = found[0]
        own = (by_matrix[:, 0, 0], by_matrix[:, 1, 1], by_matrix[:, 0, 2], by_matrix[:, 1, 2])
        return torch.cat((torch.stack(own, -1), found[2]), -1).numpy()

    return {
        EQUATIONS: (_equations(scene, upstream), lambda found: found.camera_gradient[..., OBSERVED].flatten(0, 1)),
        AUTOGRAD: (autograd, lambda found: torch.cat(found[:3], -1).flatten(0, 1).numpy()),
        KORNIA: (peers.kornia_gradient(views, pull), of_kornia),
        OPENCV: (peers.opencv_jacobian(views, pull), lambda found: found[:, OBSERVED]),
    }


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables: nanoseconds per point by size, derivatives, synthesis."""
    names = list(result["shapes"][0]["rows"])
    made = {}
    for kind, marker, unit in (("camera", "projection camera", "points"), ("rigs", "projection rigs", "rigs")):
        shapes = [shape for shape in result["shapes"] if shape["kind"] == kind]
        rows = [[name, *(_cell(shape, name) for shape in shapes), _worst(shapes, name)] for name in names]
        head = ("ns per point, p50", *(f"{shape['count']:,} {unit}" for shape in shapes), "largest difference, px")
        made[marker] = markdown(head, rows)
    shapes = result["derivatives"]
    labels = [f"{s['count']:,} points" if s["kind"] == "camera" else f"{s['count']:,} rigs" for s in shapes]
    rows = [
        [name, what, *(_cell(shape, name) for shape in shapes), _worst(shapes, name, "{:.0e}")]
        for name, what in COMPUTES.items()
    ]
    made["projection derivatives"] = markdown(
        ("ns per point, p50", "result", *labels, "largest relative difference"), rows
    )
    rows = [
        [row["name"], *(f"{1e3 * row['rigs'] / row['times'][n]['p50']:,.0f}" for n in row["times"])]
        for row in result["synthesis"]["rows"]
    ]
    threads = [f"{n} thread{'s' * (n != '1')}" for n in result["synthesis"]["rows"][0]["times"]]
    made["synthesis"] = markdown(("rigs/s", *threads), rows)
    return made


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw nanoseconds per point, over points of one camera and over rigs."""
    with figure(path, panels=2, size=(9.0, 3.4)) as panels:
        for axes, kind, label in zip(panels, ("camera", "rigs"), ("points of one camera", "rigs"), strict=True):
            shapes = [shape for shape in result["shapes"] if shape["kind"] == kind]
            for number, name in enumerate(shapes[0]["rows"]):
                shown = [(s["count"], 1e6 * s["rows"][name]["p50"] / s["points"]) for s in shapes if s["rows"][name]]
                if not shown:
                    continue
                ours = name.startswith("**")
                style = ("-", "--", "-.", ":")[number % 4]
                axes.plot(
                    *zip(*shown, strict=True), style, color=BLUE if ours else GREY, marker="os^vDx*+"[number % 8],
                    markersize=4, label=name.replace("*", "").replace("`", ""),
                )  # fmt: skip
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xlabel(label)
            axes.set_ylabel("ns a point, 1 thread")
        panels[1].legend(fontsize=7, frameon=False)


def _measure_values(kind: str, count: int, effort: Effort) -> dict[str, Any]:
    scene = scene_of(kind, count)
    cases = value_cases(scene)
    ready = {name: run for name, run in cases.items() if run is not None}
    reference = ready[OPENCV]()
    rows: dict[str, Any] = dict.fromkeys(cases)
    differences = {name: float(np.abs(np.asarray(run()) - reference).max()) for name, run in ready.items()}
    for name, taken in side_by_side(ready, effort.pick(3.0, 0.05)).items():
        rows[name] = {"difference": differences[name], **taken.values()}
    return {"kind": kind, "count": count, "points": reference.size // 2, "rows": rows}


def _measure_derivatives(kind: str, count: int, effort: Effort) -> dict[str, Any]:
    scene = scene_of(kind, count)
    shape = (count if kind == "rigs" else 1, scene.rig.num_cameras, len(scene.points_object), 2)
    upstream = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    cases = derivative_cases(scene, upstream)
    found = {name: np.asarray(take(run())) for name, (run, take) in cases.items()}
    scale = np.abs(found[OPENCV]).max(0)
    times = side_by_side({name: run for name, (run, _) in cases.items()}, effort.pick(3.0, 0.05))
    rows = {
        name: {"difference": float((np.abs(found[name] - found[OPENCV]) / scale).max()), **taken.values()}
        for name, taken in times.items()
    }
    return {"kind": kind, "count": count, "points": upstream.numel() // 2, "rows": rows}


def _equations(scene: Scene, upstream: Tensor) -> Run:
    """Linearize once with the estimate's compiled loop, for observations whose residuals are `upstream`."""
    rig, points = scene.rig, scene.points_object
    centroid = points.mean(0)
    observed = rig.project_values(scene.points).uv - upstream
    uv = observed.mT[:, None].contiguous()
    ones = torch.ones_like(uv[..., 0, :])
    prior_std = torch.ones(*rig.focal_length.shape[:2], 15, dtype=uv.dtype)
    problem = Problem(uv, ones, (points - centroid).contiguous(), centroid, None, rig, prior_std)
    centre = scene.rig_from_object.apply(centroid[None])
    state = State(torch.zeros_like(prior_std), scene.rig_from_object.rotation[:, None].contiguous(), centre)
    return lambda: levenberg_marquardt_cpu.minimize(problem, state, "squared", 1.0, 0, 0.0).equations


def _measure_synthesis(effort: Effort) -> dict[str, Any]:
    """Time the synthesis of rigs for training: drift, pose, projection and visibility check, float32."""
    rig, obj = read_rig("O10").to(torch.float32), load_object("asymmetric8")
    generator = torch.Generator().manual_seed(0)
    batches, count = effort.pick(((64, 512, 4096), 512), ((8,), 8))
    made = synthesize(rig, obj, count, generator)
    points = made.rig_from_object.apply(obj.points.float())
    cases: dict[str, tuple[int, Run]] = {
        f"synthesis, batches of {batch:,}": (batch, partial(synthesize, rig, obj, batch, generator))
        for batch in batches
    }
    cases[f"its projection alone, {count:,}: compiled"] = (
        count, lambda: made.rig.project_values(points)
    )  # fmt: skip
    cases["in tensors"] = (count, lambda: made.rig.project(points))
    rows = {name: {"name": name, "rigs": rigs, "times": {}} for name, (rigs, _) in cases.items()}
    for threads in sorted({1, os.cpu_count() or 1}):
        torch.set_num_threads(threads)
        times = side_by_side({name: run for name, (_, run) in cases.items()}, effort.pick(4.0, 0.05))
        for name, taken in times.items():
            rows[name]["times"][str(threads)] = taken.values()  # type: ignore[index]
    torch.set_num_threads(1)
    return {"rows": list(rows.values())}


def _cell(shape: Mapping[str, Any], name: str) -> str:
    row = shape["rows"][name]
    return f"{1e6 * row['p50'] / shape['points']:.3g}" if row else "absent"


def _worst(shapes: list[Mapping[str, Any]], name: str, form: str = "{:.1e}") -> str:
    found = [shape["rows"][name]["difference"] for shape in shapes if shape["rows"][name]]
    return form.format(max(found)) if found else ""
