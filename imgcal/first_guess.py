"""A network's first guess for captured snapshots: labelled fiducials in, a rig and poses to start the estimate from.

Image networks never see a grey frame: the labelled fiducials are drawn anew, each in its own colour.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.formats.names import nearest
from imgcal.networks.prediction import Prediction, Views
from imgcal.networks.rendering import ImageOptions, render_views
from imgcal.objects import CalibrationObject
from imgcal.observations import Observations
from imgcal.resources import data_path, shipped_names
from imgcal.rig import CameraRig
from imgcal.training.checkpoint import check_object, check_rig, load_checkpoint
from imgcal.transforms import RigidTransform

KINDS = ("points", "vit", "cnn")


@dataclass(frozen=True)
class FirstGuess:
    """What a network says about some snapshots of one rig."""

    name: str  # of the network
    rig: CameraRig  # without batch axes: the mean over snapshots
    rig_from_object: RigidTransform  # (S,)
    residual: Tensor  # (S, C, N, 2) pixels, predicted by each snapshot's own rig minus observed; zero where not seen


@dataclass(frozen=True)
class Guesser:
    """A trained network, ready for a rig whose images may have another size than those it was trained for."""

    name: str
    network: nn.Module
    trained: CameraRig  # factory rig of the training

    @torch.no_grad()
    def guess(self, observations: Observations, rig: CameraRig, obj: CalibrationObject) -> FirstGuess:
        """Look at every snapshot on its own.

        Args:
            observations: (S, C, N) labelled fiducials, in the pixels of `rig`.
            rig: the factory rig.
            obj: the object.
        """
        size, trained_size = rig.image_size.to(observations.uv), self.trained.image_size.to(observations.uv)
        uv = ((observations.uv + 0.5) * (trained_size / size)[:, None] - 0.5).float()
        options = cast(ImageOptions | None, self.network.image_options)
        if options is None:
            views = Views(uv=uv, seen=observations.seen)
        else:
            drawn = render_views(uv, observations.seen, self.trained.image_size, obj, options, quantise=True)
            views = Views(images=drawn)
        predicted: Prediction = self.network(views)[-1].to(rig.focal_length.dtype)
        each, poses = predicted.rig.resized(rig.image_size), predicted.rig_from_object
        residual = residual_of(each, poses, observations, obj)
        return FirstGuess(self.name, rig.moved(each.difference(rig).mean(0)), poses, residual)


def residual_of(rig: CameraRig, poses: RigidTransform, observations: Observations, obj: CalibrationObject) -> Tensor:
    """Predicted minus observed: (S, C, N, 2) pixels, zero where not seen; one rig a snapshot or one for all."""
    uv = rig.expand(len(observations.uv)).project(poses.apply(obj.points.to(poses.rotation)), obj.radius).uv
    return torch.where(observations.seen[..., None], uv - observations.uv, 0.0)


def load_guesser(name: str, rig: CameraRig, obj: CalibrationObject) -> Guesser:
    """Find the network for a rig and an object.

    Args:
        name: one of `KINDS`, for the shipped networks, or a file that `imgcal train` wrote.
        rig: the factory rig; its images may be smaller or larger than those of the training.
        obj: the object; the radius of its fiducials does not matter to a first guess.

    Raises:
        InputError: no such file, or no network for this rig and object.
    """
    if name not in KINDS:
        if not Path(name).is_file():
            raise InputError(
                f"first guess: found `{name}`, expected none, {', '.join(KINDS)}, or a file of `imgcal train`"
                f"{nearest(name, KINDS)}"
            )
        return _load(Path(name), rig, obj)
    shipped = [stem for stem in shipped_names("models", ".safetensors") if stem.startswith(f"{name}-")]
    reasons = []
    for stem in shipped:
        try:
            return _load(data_path("models", f"{stem}.safetensors"), rig, obj)
        except InputError as error:
            reasons.append(error)
    why = "".join(f" ({reason})" for reason in reasons[:1])
    raise InputError(
        f"first guess `{name}`: found no shipped network for rig {rig.name} and object {obj.name}, expected one of "
        f"{', '.join(shipped) or 'none'}: train one with `imgcal train` and give its file{why}"
    )


def _load(path: Path, rig: CameraRig, obj: CalibrationObject) -> Guesser:
    checkpoint = load_checkpoint(path)
    if rig.cameras == checkpoint.rig.cameras:
        rig = rig.resized(checkpoint.rig.image_size)
    check_rig(path, checkpoint.rig, rig)
    check_object(path, replace(checkpoint.obj, radius=None), replace(obj, radius=None))
    return Guesser(path.stem, checkpoint.network, checkpoint.rig)
