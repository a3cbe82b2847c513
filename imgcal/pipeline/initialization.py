"""A network's first guess for captured snapshots: from labelled fiducials to a rig and poses to start the estimate.

Image networks never see a grey frame: the labelled fiducials are redrawn, each in its own colour.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import RigidTransform, resized_pixels
from imgcal.io import data_path, model_file, model_name, nearest, shipped_names
from imgcal.networks import Network, check_object, check_rig, check_says_rigs, load_checkpoint, read_subject
from imgcal.synthesis import render_views
from imgcal.types import CalibrationObject, CameraRig, Observations, Prediction, Symmetry, Views

KINDS = ("points", "vit", "cnn")
CHUNK = 32  # snapshots per batch: their images take memory


@dataclass(frozen=True)
class Initialization:
    """A network's estimate for some snapshots of one rig."""

    name: str  # name of the network
    rig: CameraRig  # without batch axes: the mean over snapshots
    rig_from_object: RigidTransform  # (S,)
    residual: Tensor  # (S, C, N, 2) pixels, predicted by each snapshot's own rig minus observed; zero where not seen


@dataclass(frozen=True)
class Initializer:
    """A trained network for a rig with some or all of its cameras and images of any size."""

    name: str
    network: Network
    trained: CameraRig  # factory rig used in training
    cameras: tuple[int, ...] | None = None  # present cameras, in the order of the rig; None = all

    @torch.no_grad()
    def guess(self, observations: Observations, rig: CameraRig, obj: CalibrationObject) -> Initialization:
        """Process every snapshot independently.

        A symmetric object may have been labelled in an orientation that the network never saw in training: all are
        tried, and each snapshot keeps the one that fits best.

        Args:
            observations: (S, C, N) labelled fiducials, in the pixels of `rig`.
            rig: the factory rig.
            obj: the object.
        """
        shown = self._make_views(observations, rig)
        turns = [self._turn(shown, rig, obj, motion) for motion in obj.symmetries]
        residuals = torch.stack([prediction_residual(turn, observations, obj) for turn in turns])  # (turns, S, C, N, 2)
        best = residuals.square().sum((2, 3, 4)).nan_to_num(torch.inf).argmin(0), torch.arange(len(observations.uv))
        guess = Prediction.combine(turns, lambda tensors: torch.stack(tensors)[best])
        mean = rig.retract(guess.rig.local(rig).mean(0))
        return Initialization(self.name, mean, guess.rig_from_object, residuals[best])

    def _make_views(self, observations: Observations, rig: CameraRig) -> Views:
        """Views of all cameras of the training rig; missing cameras see nothing."""
        cameras = self._present
        scale = self.trained.image_size[cameras].to(observations.uv) / rig.image_size
        snapshots, _, fiducials = observations.seen.shape
        uv = torch.zeros(snapshots, self.trained.num_cameras, fiducials, 2)
        uv[:, cameras] = resized_pixels(observations.uv, scale[:, None]).float()
        seen = torch.zeros(uv.shape[:-1], dtype=torch.bool)
        seen[:, cameras] = observations.seen
        return Views(uv=uv, seen=seen)

    @property
    def _present(self) -> list[int]:
        return list(range(self.trained.num_cameras) if self.cameras is None else self.cameras)

    def _turn(self, shown: Views, rig: CameraRig, obj: CalibrationObject, motion: Symmetry) -> Prediction:
        """Prediction for an object turned by a symmetry, turned back: (S,), in the pixels of `rig`."""
        assert shown.uv is not None and shown.seen is not None
        source = torch.from_numpy(np.argsort(motion.permutation))  # fiducial whose image each label receives
        views = zip(shown.uv[:, :, source].split(CHUNK), shown.seen[:, :, source].split(CHUNK), strict=True)
        said = Prediction.cat([self._predict(*chunk, obj) for chunk in views]).to(rig.focal_length.dtype)
        turn = RigidTransform(torch.from_numpy(motion.rotation), torch.from_numpy(motion.translation))
        there = said.rig.select(self._present).resized(rig.image_size)
        return Prediction(there, said.rig_from_object @ turn.to(rig.focal_length.dtype))

    def _predict(self, uv: Tensor, seen: Tensor, obj: CalibrationObject) -> Prediction:
        options = self.network.image_options
        views = Views(uv=uv, seen=seen)
        if options is not None:
            views = Views(images=render_views(uv, seen, self.trained.image_size, obj, options, quantise=True))
        prediction: Prediction = self.network(views)[-1]
        return prediction


def prediction_residual(prediction: Prediction, observations: Observations, obj: CalibrationObject) -> Tensor:
    """Predicted minus observed: (S, C, N, 2) pixels, zero where not seen; one rig per snapshot (S,) or one for all."""
    poses = prediction.rig_from_object
    rigs = prediction.rig.expand(len(observations.uv))
    uv = rigs.project(poses.apply(obj.points.to(poses.rotation)), obj.radius).uv
    return torch.where(observations.seen[..., None], uv - observations.uv, 0.0)


def load_initializer(
    name: str, rig: CameraRig, obj: CalibrationObject, *, trusted: Collection[str] = ()
) -> Initializer:
    """Find the network for a rig and an object.

    Args:
        name: one of `KINDS`, for the shipped networks, or a file written by `imgcal train`, or its folder.
        rig: the factory rig: all cameras of the training or some of them; its images may be smaller or larger.
        obj: the object; the radius of its fiducials does not matter for a first guess.
        trusted: your encoders that a file may name, and whose code then runs; see `load_checkpoint`.

    Raises:
        InputError: no such file, or no network for this rig and object.

    Examples:
        >>> import imgcal
        >>> load_initializer("points", imgcal.load_rig("O10"), imgcal.load_object("cube8")).name
        'points-O10-cube8'
    """
    if name not in KINDS:
        path = model_file(name)
        if not path.is_file():
            raise InputError(
                f"first guess: found `{name}`, expected none, {', '.join(KINDS)}, or what `imgcal train` wrote: a file "
                f"or its folder{nearest(name, KINDS)}"
            )
        return _load(path, rig, obj, trusted)
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
        f"{', '.join(shipped) or 'those of imgcal-models'}: train one with `imgcal train` and give its file{why}"
    )


def _load(path: Path, rig: CameraRig, obj: CalibrationObject, trusted: Collection[str] = ()) -> Initializer:
    trained, trained_obj = read_subject(path)
    cameras = tuple(trained.camera_names.index(name) for name in rig.camera_names if name in trained.camera_names)
    there = trained.select(cameras) if len(cameras) == rig.num_cameras else trained
    check_rig(path, there, rig.resized(there.image_size) if rig.num_cameras == there.num_cameras else rig)
    check_object(path, replace(trained_obj, radius=None), replace(obj, radius=None))
    checkpoint = load_checkpoint(path, trusted=trusted)
    check_says_rigs(path, checkpoint.experiment)
    return Initializer(model_name(path), checkpoint.network, trained, cameras)
