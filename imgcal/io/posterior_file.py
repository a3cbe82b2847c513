"""The posterior of a calibrated rig in a file beside it: arrays, not meant for editing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from imgcal.errors import InputError
from imgcal.io.atomic import write_bytes
from imgcal.io.safetensors_file import read_tensors, tensor_bytes
from imgcal.types import CameraRig, RigPosterior

FORMAT = "imgcal-posterior/1"
RIG = ("focal_length", "principal_point", "distortion")
OWN = ("points", "tolerance", "object_offset", "factor", "unit")


def write_posterior(path: str | Path, posterior: RigPosterior) -> None:
    """Write a posterior in one step.

    Raises:
        InputError: the file cannot be written.
    """
    write_bytes(path, posterior_bytes(posterior))


def posterior_bytes(posterior: RigPosterior) -> bytes:
    """Make the content that `write_posterior` writes."""
    rig = posterior.rig
    tensors = {name: getattr(rig, name) for name in RIG} | {name: getattr(posterior, name) for name in OWN}
    tensors |= {"rotation": rig.cam_from_rig.rotation, "translation": rig.cam_from_rig.translation}
    texts = {"snapshots": str(posterior.snapshots), "scale_tolerance": repr(posterior.scale_tolerance)}
    if posterior.time is not None:
        texts["time"] = repr(posterior.time)
    return tensor_bytes(tensors, FORMAT, texts)


def read_posterior(path: str | Path, rig: CameraRig) -> RigPosterior:
    """Read what `write_posterior` wrote.

    Args:
        path: the file.
        rig: the one that it stands beside: names, image sizes and lenses are its own.

    Raises:
        InputError: one line with the file, what was found and what was expected.
    """
    tensors, texts = read_tensors(path, FORMAT)
    try:
        cam_from_rig = replace(rig.cam_from_rig, rotation=tensors["rotation"], translation=tensors["translation"])
        focal, principal, distortion = (tensors[name] for name in RIG)
        lens = replace(rig, focal_length=focal, principal_point=principal, distortion=distortion)
        posterior = RigPosterior(
            replace(lens, cam_from_rig=cam_from_rig, posterior=None),
            snapshots=int(texts["snapshots"]),
            scale_tolerance=float(texts["scale_tolerance"]),
            time=float(texts["time"]) if "time" in texts else None,
            **{name: tensors[name] for name in OWN},
        )
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: found no {error}, expected {FORMAT}") from error
    wide = posterior.unit.numel() + len(posterior.object_offset)
    expected = rig.num_cameras, rig.num_parameters
    if tuple(posterior.unit.shape) != expected or tuple(posterior.factor.shape) != (wide, wide):
        found = f"{tuple(posterior.unit.shape)} and {tuple(posterior.factor.shape)}"
        raise InputError(f"{path}: found arrays {found}, expected {expected} and {(wide, wide)} for this rig")
    if not bool(torch.isfinite(posterior.factor).all() & (posterior.factor.diagonal() > 0).all()):
        raise InputError(f"{path}: expected a finite, positive-definite Cholesky factor")
    return posterior
