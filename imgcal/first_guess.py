"""A network's first guess for captured snapshots: labelled fiducials in, a rig and poses to start the estimate from.

Image networks never see a grey frame: the labelled fiducials are drawn anew, each in its own colour.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.formats.names import nearest
from imgcal.networks.prediction import Prediction, Views
from imgcal.networks.rendering import ImageOptions, render_views
from imgcal.objects import CalibrationObject, SelfMotion
from imgcal.observations import Observations
from imgcal.resources import data_path, shipped_names
from imgcal.rig import CameraRig
from imgcal.training.checkpoint import check_object, check_rig, load_checkpoint
from imgcal.transforms import RigidTransform

KINDS = ("points", "vit", "cnn")
CHUNK = 32  # snapshots at once: their images take memory


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

        A symmetric object may have been labelled in a turn that the network has never seen: all turns are tried, and
        each snapshot keeps the one that fits best.

        Args:
            observations: (S, C, N) labelled fiducials, in the pixels of `rig`.
            rig: the factory rig.
            obj: the object.
        """
        size, trained_size = rig.image_size.to(observations.uv), self.trained.image_size.to(observations.uv)
        uv = ((observations.uv + 0.5) * (trained_size / size)[:, None] - 0.5).float()
        offsets, poses, residual = self._turned(uv, observations, rig, obj, obj.symmetries[0])
        for motion in obj.symmetries[1:]:
            more = self._turned(uv, observations, rig, obj, motion)
            better = more[2].square().sum((1, 2, 3)) < residual.square().sum((1, 2, 3))
            rotation = torch.where(better[:, None, None], more[1].rotation, poses.rotation)
            poses = RigidTransform(rotation, torch.where(better[:, None], more[1].translation, poses.translation))
            offsets = torch.where(better[:, None, None], more[0], offsets)
            residual = torch.where(better[:, None, None, None], more[2], residual)
        return FirstGuess(self.name, rig.moved(offsets.mean(0)), poses, residual)

    def _turned(
        self, uv: Tensor, observations: Observations, rig: CameraRig, obj: CalibrationObject, motion: SelfMotion
    ) -> tuple[Tensor, RigidTransform, Tensor]:
        """What the network says of an object turned by a symmetry, turned back.

        Returns:
            Offsets (S, C, 15) from the factory rig, poses (S,), residuals (S, C, N, 2).
        """
        source = torch.from_numpy(np.argsort(motion.permutation))  # fiducial whose image each label gets
        predictions = [
            self._predict(some, seen, obj)
            for some, seen in zip(
                uv[:, :, source].split(CHUNK), observations.seen[:, :, source].split(CHUNK), strict=True
            )
        ]
        dtype = rig.focal_length.dtype
        turn = RigidTransform(torch.from_numpy(motion.rotation), torch.from_numpy(motion.translation)).to(dtype)
        rotation = torch.cat([p.rig_from_object.rotation for p in predictions]).to(dtype)
        translation = torch.cat([p.rig_from_object.translation for p in predictions]).to(dtype)
        poses = RigidTransform(rotation, translation) @ turn
        factory = self.trained.to(dtype)
        offsets = torch.cat([p.rig.to(dtype).difference(factory) for p in predictions])
        each = factory.moved(offsets).resized(rig.image_size)
        return each.difference(rig), poses, residual_of(each, poses, observations, obj)

    def _predict(self, uv: Tensor, seen: Tensor, obj: CalibrationObject) -> Prediction:
        options = cast(ImageOptions | None, self.network.image_options)
        views = Views(uv=uv, seen=seen)
        if options is not None:
            views = Views(images=render_views(uv, seen, self.trained.image_size, obj, options, quantise=True))
        prediction: Prediction = self.network(views)[-1]
        return prediction


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
