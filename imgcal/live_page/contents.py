"""States, events, frames and beliefs as plain values that the server's process takes: no tensors, no large frames."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

import imgcal
from imgcal.estimation import WorkingVolume
from imgcal.live_page.acknowledgements import Acknowledgements
from imgcal.live_page.address import Address
from imgcal.live_page.commands import Action
from imgcal.live_page.rig_drawing import arrangement
from imgcal.online import Event, RigState
from imgcal.types import CalibrationObject, CameraRig

Frame = NDArray[np.uint8] | NDArray[np.uint16]

PICTURE_WIDTH = 480  # pixels
QUALITY = 80  # of JPEG
BRIGHT = 0.9997  # quantile of a picture that is shown white; its median is shown black
LEAST_RANGE = 0.2  # of the depth, between black and white: what differs less is noise
LEAST_BLOBS = 4  # in some camera: with fewer, no object is in view
DEPTHS = (255, 1023, 4095, 16383, 65535)  # largest values of cameras that write 16 bit


def greeting(
    rig: CameraRig,
    obj: CalibrationObject,
    volume: WorkingVolume,
    address: Address,
    token: str,
    actions: Sequence[Action],
    title: str,
) -> dict[str, Any]:
    """Make the first message to the server."""
    return {
        "address": address,
        "token": token,
        "actions": tuple(actions),
        "title": title,
        "version": imgcal.__version__,
        "rig_name": rig.name,
        "object_name": obj.name,
        "cameras": rig.camera_names,
        "points": obj.points.double().numpy(),
        "volume": (volume.low.double().numpy(), volume.high.double().numpy()),
        "image_size": rig.image_size.numpy(),
        "arrangement": arrangement(rig, volume),
        "notes": Acknowledgements(),
    }


def state_message(state: RigState, obj: CalibrationObject) -> dict[str, Any]:
    """Describe what changes with every snapshot."""
    pose = state.rig_from_object
    points = None if pose is None else pose.apply(obj.points.to(pose.translation)).detach().reshape(-1, 3).numpy()
    blobs = state.detections
    return {
        "time": float(state.time),
        "snapshot": int(state.snapshot),
        "sentence": state.sentence,
        "refused": state.refused,
        "in_view": state.refused is None or bool(blobs.count_by_camera(blobs.usable).max() >= LEAST_BLOBS),
        "health": [str(state.cameras[name]) for name in state.rig.camera_names],
        "residual": np.asarray(state.residual, dtype=np.float64),
        "sees": blobs.count_by_camera(blobs.labelled),
        "object": points,
    }


def event_message(event: Event) -> dict[str, Any]:
    """Describe one event; numbers that are not finite are left out."""
    return {
        name: getattr(event, name)
        for name in ("time", "snapshot", "kind", "camera", "since", "change", "size", "sigma", "unit", "message")
    }


def belief_message(state: RigState) -> dict[str, Any]:
    """The rig, its uncertainty and its reference, pickled, to be read when needed."""
    pose, blobs = state.rig_from_object, state.detections
    labelled = blobs.fiducial >= 0
    turn = torch.eye(3, dtype=torch.float64) if pose is None else pose.rotation.detach().double().reshape(-1, 3, 3)[-1]
    sigma = float(np.median(blobs.sigma[labelled])) if labelled.any() else None
    belief = replace(state.belief)  # without what follows from its values
    return {"time": float(state.time), "pickled": pickle.dumps((belief, state.factory, turn)), "sigma": sigma}


def picture_message(state: RigState, camera: int, frames: Mapping[str, Frame | None]) -> dict[str, Any]:
    """A camera's latest frame, small, and what was found in it and expected; places are shares of the image."""
    name = state.rig.camera_names[camera]
    size = state.rig.image_size[camera].double().numpy()
    blobs = state.detections
    rows = blobs.camera == camera
    predicted = np.asarray(state.predicted, dtype=np.float64)[camera]
    frame = frames.get(name)
    return {
        "camera": camera,
        "time": float(state.time),
        "jpeg": None if frame is None else small_jpeg(frame),
        "detected": (blobs.uv[rows] + 0.5) / size,
        "labelled": blobs.fiducial[rows] >= 0,
        "predicted": (predicted[np.isfinite(predicted).all(1)] + 0.5) / size,
    }


def small_jpeg(frame: Frame) -> bytes:
    """Shrink a grey image (H, W) of 8 or 16 bit, brighten it so that markers are seen, and compress it."""
    small = _shrink(frame)
    brightest = int(small.max(initial=0))
    depth = 255 if frame.dtype == np.uint8 else next(d for d in DEPTHS if brightest <= d)
    ranks = (small.size // 2, int(BRIGHT * (small.size - 1)))
    ordered = np.partition(small, ranks, axis=None)
    black = float(ordered[ranks[0]])
    white = max(float(ordered[ranks[1]]), black + depth * LEAST_RANGE)
    picture = np.clip((small - np.float32(black)) * (255.0 / (white - black)), 0, 255).astype(np.uint8)
    found, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return jpeg.tobytes() if found else b""


def _shrink(frame: Frame) -> NDArray[Any]:
    """Average down to the width of a picture: by a whole number first, where there is one: twice as quick."""
    height, width = frame.shape
    scale = min(1.0, PICTURE_WIDTH / width)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    whole = min(width // size[0], height // size[1])
    smaller: NDArray[Any] = frame
    if whole > 1 and width % whole == height % whole == 0:
        smaller = cv2.resize(smaller, (width // whole, height // whole), interpolation=cv2.INTER_AREA)
    return smaller if scale == 1.0 else cv2.resize(smaller, size, interpolation=cv2.INTER_AREA)
