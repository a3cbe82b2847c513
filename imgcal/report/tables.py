"""Rows of the tables of the report: plain values, which the template writes and escapes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from imgcal.geometry import LENS_MODELS
from imgcal.report import svg
from imgcal.report.content import ReportContent
from imgcal.types import PARAMETER_KINDS

MINUS = "\N{MINUS SIGN}"

GROUPS: tuple[tuple[str, slice, tuple[str, ...], float], ...] = (
    ("focal length (px)", PARAMETER_KINDS["focal_length"], ("fx", "fy"), 1.0),
    ("principal point (px)", PARAMETER_KINDS["principal_point"], ("cx", "cy"), 1.0),
    ("distortion (10⁻³)", PARAMETER_KINDS["distortion"], (), 1e3),
    ("rotation (deg)", PARAMETER_KINDS["rotation"], ("x", "y", "z"), 180 / math.pi),
    ("position (mm)", PARAMETER_KINDS["position"], ("x", "y", "z"), 1.0),
)
"""Columns: heading, which parameters, their names (none = those of the camera's lens), factor to the unit shown."""


@dataclass(frozen=True)
class Change:
    """One parameter of one camera."""

    name: str
    change: str
    std: str
    kind: str  # "" | "moved" | "unknown" | "fixed"
    value: str = ""  # recalibrated value, shown on hovering


@dataclass(frozen=True)
class CameraRow:
    """One camera."""

    name: str
    observations: int
    blobs: int
    before: str
    after: str
    groups: tuple[tuple[Change, ...], ...]  # as in GROUPS; empty when refused
    moved: tuple[str, ...]  # headings of the groups that moved
    reference: bool


@dataclass(frozen=True)
class KnowledgeRow:
    """How much the data say about one parameter."""

    label: str
    share: int  # per cent: standard deviation after over that before
    unknown: bool
    tip: str


def camera_rows(content: ReportContent) -> list[CameraRow]:
    """Describe every camera."""
    count = len(content.cameras)
    before = content.rms_by(content.detections.camera, content.residual_before, count)
    after = content.rms_by(content.detections.camera, content.residual_after, count)
    blobs = content.detections.count_by_camera()
    rows = []
    for i, name in enumerate(content.cameras):
        groups = tuple(_changes(content, i, *group[1:]) for group in GROUPS) if content.change is not None else ()
        moved = tuple(
            group[0].split(" (")[0]
            for group, changes in zip(GROUPS, groups, strict=False)
            if any(change.kind == "moved" for change in changes)
        )
        rows.append(CameraRow(
            name, int(content.observations[i]), int(blobs[i]), _pixels(before[i]), _pixels(after[i]), groups, moved,
            reference=i == content.reference and count > 1,
        ))  # fmt: skip
    return rows


def columns(content: ReportContent) -> list[int]:
    """Parameters that some camera has."""
    return [i for i, name in enumerate(content.factory.parameter_names) if name != "-"]


def knowledge_rows(content: ReportContent) -> list[list[KnowledgeRow]]:
    """Compare the standard deviations after and before the data: C rows of `columns`; none when refused."""
    std, prior = content.std, content.prior_std
    if std is None or prior is None:
        return []
    rows = []
    for camera, name in enumerate(content.cameras):
        cells = []
        own = content.factory.parameter_names_of(camera)
        for i in columns(content):
            parameter = own[i]
            if parameter == "-":
                tip = f"{name} {content.factory.parameter_names[i]}: not of its lens"
                cells.append(KnowledgeRow("·", 0, False, tip))
                continue
            if content.fixed[camera, i]:
                fixed = "reference" if camera == content.reference and i < 6 else "fixed"
                cells.append(KnowledgeRow("·", 0, False, f"{name} {parameter}: {fixed}"))
                continue
            share = 100 * std[camera, i] / prior[camera, i]
            tip = f"{name} {parameter}: ± {std[camera, i]:.3g} after, ± {prior[camera, i]:.3g} before"
            label = f"{share:.0f}" if share >= 1 else "<1"
            cells.append(KnowledgeRow(label, min(round(share), 100), bool(content.undetermined[camera, i]), tip))
        rows.append(cells)
    return rows


def format_signed(value: float, std: float) -> tuple[str, str]:
    """Write a value and its standard deviation to two digits of the latter: ("+7.31", "0.42")."""
    if not (math.isfinite(std) and std > 0):
        return _sign(f"{value:+.3g}"), ""
    digits = min(max(1 - math.floor(math.log10(std)), 0), 8)
    return _sign(f"{value:+.{digits}f}"), f"{std:.{digits}f}"


def _changes(
    content: ReportContent, camera: int, columns: slice, names: tuple[str, ...], factor: float
) -> tuple[Change, ...]:
    if content.change is None or content.recalibrated is None:
        return ()
    rig = content.recalibrated
    names = names or LENS_MODELS[rig.lens_models[camera]].coefficients
    absolute = {
        6: rig.focal_length[camera], 8: rig.principal_point[camera], 10: rig.distortion[camera],
    }.get(columns.start)  # fmt: skip
    cells = []
    for k, (i, name) in enumerate(zip(range(columns.start, columns.start + len(names)), names, strict=True)):
        spread = math.nan if content.std is None else content.std[camera, i]
        change, std = format_signed(content.change[camera, i] * factor, spread * factor)
        kind = "moved" if content.moved[camera, i] else "unknown" if content.undetermined[camera, i] else ""
        if content.fixed[camera, i]:
            kind = "fixed"
        value = "" if absolute is None else f"{name} = {float(absolute[k]):.6g}"
        cells.append(Change(name, change, std, kind, value))
    return tuple(cells)


def _sign(text: str) -> str:
    zero = not any(digit in text for digit in "123456789")
    return text.replace("-", "+" if zero else MINUS)


def _pixels(value: float) -> str:
    return "" if math.isnan(value) else svg.pixels(value)
