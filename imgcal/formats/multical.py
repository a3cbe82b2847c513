"""multical `calibration.json`: `camB_to_camA` holds X_B = R X_A + T, where A is the master; metres."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from imgcal.formats import places
from imgcal.formats.chains import IDENTITY, Link, Pose, follow_links
from imgcal.formats.documents import Document
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.format import Files, Format
from imgcal.formats.lens import Lens
from imgcal.formats.source import Source
from imgcal.formats.values import (
    array,
    camera_matrix,
    coefficients,
    image_size,
    mapping,
    numbers,
    rotation,
    text,
)
from imgcal.messages import name_cameras

TITLE = "multical calibration.json"
MODELS = {"standard": (0, 4, 5), "rational": (5, 8), "thin_prism": (5, 8, 12), "tilted": (5, 8, 12, 14)}


def _values(source: Source) -> tuple[Document, dict[str, Any]] | None:
    for document, values in source.mappings:
        cameras = values.get("cameras")
        if document.kind == "json" and isinstance(cameras, dict) and any(
            isinstance(camera, dict) and "K" in camera for camera in cameras.values()
        ):  # fmt: skip
            return document, values
    return None


def _read(source: Source) -> ForeignRig:
    found_values = _values(source)
    assert found_values is not None
    document, values = found_values
    cameras = mapping(values["cameras"], "cameras")
    if not isinstance(values.get("camera_poses"), dict):
        raise FormatError("found only intrinsics (no camera_poses): give calibration.json, which has both")
    poses, links, masters = values["camera_poses"], [], []
    for key, value in poses.items():
        entry = mapping(value, key)
        pose = rotation(entry.get("R"), f"{key}: R"), array(entry.get("T"), (3,), f"{key}: T")
        if key in cameras:
            masters.append(key)
            if np.abs(pose[1]).max() > 1e-6 or np.abs(pose[0] - np.eye(3)).max() > 1e-6:
                links.append(Link(key, "", pose))
            continue
        ends = [(a, b) for a in cameras for b in cameras if key == f"{a}_to_{b}"]
        if not ends:
            raise FormatError(f"camera_poses: found {key}, expected NAME or NAME_to_MASTER of the cameras")
        links.append(Link(*ends[0], pose))
    root = masters[0] if masters else next((link.source for link in links), next(iter(cameras)))
    lost = sorted(set(cameras) - {root} - {end for link in links for end in (link.destination, link.source)})
    posed = [name for name in cameras if name not in lost]
    notes = ["`B_to_A` holds B_from_A, A the master; metres"]
    if lost:
        notes.append(f"{name_cameras(lost)}: left out, without a pose")
    if not links and len(cameras) > 1:
        raise FormatError("camera_poses holds no pose of one camera to another")
    found = follow_links(root, posed, links) if links else {root: IDENTITY}
    made = [ForeignCamera(name, _lens(name, cameras[name]), _size(name, cameras[name]), *found[name]) for name in posed]
    made = [replace(camera, places=_places(document.path, camera, poses, posed)) for camera in made]
    return ForeignRig(FORMAT.name, tuple(made), "m", f"camera {root}", tuple(notes), root=posed.index(root))


def _places(path: Path, camera: ForeignCamera, poses: dict[str, Any], names: list[str]) -> tuple[Place, ...]:
    name = camera.name
    before = (camera.rotation, camera.translation)
    found = [
        Place(path, ("cameras", name, "K"), places.camera_matrix),
        Place(path, ("cameras", name, "dist"), places.coefficients(len(camera.lens.coefficients))),
    ]
    for key, entry in poses.items():
        turn = numbers(entry["R"], key)
        parts = {"R": places.rotation_like(turn), "T": places.translation}
        others = [place for place, other in enumerate(names) if key == f"{name}_to_{other}"]
        if others:
            found += [Place(path, ("camera_poses", key, part), of, relative_to=others[0]) for part, of in parts.items()]
        elif key == name:
            pose: Pose = rotation(entry["R"], key), array(entry["T"], (3,), key)
            if np.abs(pose[1]).max() > 1e-6 or np.abs(pose[0] - np.eye(3)).max() > 1e-6:
                found += [
                    Place(path, ("camera_poses", key, part), places.carry_pose(before, pose, of))
                    for part, of in parts.items()
                ]
    return tuple(found)


def _lens(name: str, entry: Any) -> Lens:
    entry = mapping(entry, name)
    model = text(entry.get("model", "standard"), f"{name}: model")
    if model not in MODELS:
        raise FormatError(f"{name}: found the model {model!r}, expected one of {', '.join(MODELS)}")
    focal, centre, skew = camera_matrix(entry.get("K"), f"{name}: K")
    return Lens(focal, centre, coefficients(entry.get("dist"), f"{name}: dist", MODELS[model]), "opencv", skew)


def _size(name: str, entry: Any) -> tuple[int, int] | None:
    return image_size(entry.get("image_size"), f"{name}: image_size")


def _write(rig: ForeignRig) -> Files:
    master = rig.cameras[0].name
    cameras, poses = {}, {}
    for camera in rig.cameras:
        count, model = next(
            (count, model) for count, model in ((5, "standard"), (8, "rational"), (12, "thin_prism"), (14, "tilted"))
            if camera.lens.length <= count
        )  # fmt: skip
        cameras[camera.name] = {
            "model": model,
            "image_size": list(camera.image_size or ()),
            "K": camera.lens.matrix.tolist(),
            "dist": [camera.lens.pad(count)],
        }
        key = camera.name if camera.name == master else f"{camera.name}_to_{master}"
        poses[key] = {"R": camera.rotation.tolist(), "T": camera.translation.tolist()}
    return {"": (json.dumps({"cameras": cameras, "camera_poses": poses}, indent=2) + "\n").encode()}


FORMAT = Format(
    "multical", TITLE, lambda source: _values(source) is not None, _read, _write, Holds((5, 8, 12, 14)),
    states_unit=True, from_first=True,
)  # fmt: skip
