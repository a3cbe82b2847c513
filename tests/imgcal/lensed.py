"""Rigs with other lenses than the shipped ones have."""

from dataclasses import replace

import torch

from imgcal.geometry import lens_label, lens_width
from imgcal.types import CameraRig

LENSES = {
    "brown_conrady": (-0.2, 0.05, 1e-3, -1e-3, 0.01),
    "rational": (0.5, 0.1, 1e-3, -1e-3, 0.01, 0.8, 0.2, 0.02),
    "equidistant": (0.02, -0.01, 0.003, -0.001),
}
"""Coefficients of real lenses' size."""
KINDS = {
    "rational": ("rational",),
    "equidistant": ("equidistant",),
    "mixed": ("equidistant", "brown_conrady", "rational"),
}
"""Lens models of the cameras in turn."""


def lensed(rig: CameraRig, kind: str) -> CameraRig:
    """The rig with the lenses of a kind in turn."""
    names = [KINDS[kind][camera % len(KINDS[kind])] for camera in range(rig.num_cameras)]
    distortion = torch.zeros(len(names), lens_width(tuple(names)), dtype=rig.distortion.dtype)
    for row, name in zip(distortion, names, strict=True):
        row[: len(LENSES[name])] = torch.tensor(LENSES[name])
    return replace(rig, distortion=distortion, lens_model=lens_label(names), name=f"{rig.name}-{kind}")
