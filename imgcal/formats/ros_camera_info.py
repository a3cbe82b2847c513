"""ROS camera_info: one file a camera; where two cameras stand is in P and R of a stereo pair, and nowhere else.

P[0, 3] = Tx = -fx' B in metres, R turns a camera into the common rectified frame:
X_right = R_r^T (R_l X_left + (Tx / fx', Ty / fy', 0)).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from imgcal.formats import places
from imgcal.formats.documents import Document
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place, unplaced_camera
from imgcal.formats.format import Files, Format
from imgcal.formats.lens import Array, Lens, Model
from imgcal.formats.source import Source
from imgcal.formats.values import array, camera_matrix, coefficients, image_size, nearest_rotation, numbers, text
from imgcal.io import Flow, yaml_text
from imgcal.messages import name_cameras

TITLE = "ROS camera_info file"
KEYS = {
    "width": ("image_width", "width"), "height": ("image_height", "height"), "k": ("camera_matrix", "K", "k"),
    "d": ("distortion_coefficients", "D", "d"), "r": ("rectification_matrix", "R", "r"),
    "p": ("projection_matrix", "P", "p"), "model": ("distortion_model",), "name": ("camera_name",),
}  # fmt: skip
MODELS: dict[str, tuple[Model, tuple[int, ...]]] = {
    "plumb_bob": ("opencv", (0, 4, 5)), "radtan": ("opencv", (0, 4, 5)), "": ("opencv", (0, 4, 5, 8, 12, 14)),
    "rational_polynomial": ("opencv", (8, 12, 14)), "equidistant": ("fisheye", (4,)), "fisheye": ("fisheye", (4,)),
}  # fmt: skip


@dataclass(frozen=True)
class _Info:
    name: str
    lens: Lens
    image_size: tuple[int, int] | None
    rectified: Array  # (3, 3): rectified_from_camera
    projection: Array  # (3, 4)
    path: Path
    keys: dict[str, tuple[str, ...]]  # to the numbers of k, d, r and p
    cut: bool  # images are binned, or a part of what the sensor has

    @property
    def places(self) -> tuple[Place, ...]:
        """Where the lens stands; a projection that is K goes along with it."""
        found = {"k": places.camera_matrix, "d": places.coefficients(len(self.lens.coefficients))}
        if not self.shift.any() and np.allclose(self.projection[:, :3], self.lens.matrix, rtol=1e-9):
            found["p"] = lambda camera: np.column_stack((camera.lens.matrix, np.zeros(3))).ravel().tolist()
        return tuple(Place(self.path, self.keys[key], of) for key, of in found.items() if key in self.keys)

    @property
    def shift(self) -> Array:
        """Of the rectified camera relative to the one without Tx and Ty: (3,) m."""
        p = self.projection
        return np.array([p[0, 3] / p[0, 0], p[1, 3] / p[1, 1], 0.0])


def _recognizes(source: Source) -> bool:
    return any(_is_info(values) for _, values in source.mappings)


def _is_info(values: dict[str, Any]) -> bool:
    has = {key for key, names in KEYS.items() if any(name in values for name in names)}
    return {"k", "d", "model"} <= has or ({"k", "p"} <= has and bool({"r", "name"} & has))


def _read(source: Source) -> ForeignRig:
    infos = _infos(source)
    if len(infos) > 2:
        first, second = (info.path.name for info in infos[:2])
        raise FormatError(f"{len(infos)} files: ROS camera_info files hold the poses of two cameras at most, and those "
                          f"of more are only in /tf: give the two of a pair (imgcal convert {first} {second} --out "
                          "rig.yaml), or the folder to imgcal calibrate --cameras, which finds the poses")  # fmt: skip
    if len(infos) == 1:
        return _single(infos[0])
    cut = [info.name for info in infos if info.cut]
    infos.sort(key=lambda info: float(np.abs(info.shift).sum()))  # the left one has no Tx
    left, right = infos
    if not right.shift.any():
        raise FormatError(
            "two files without Tx in P: these are single cameras without a pose relative to each other; "
            "imgcal calibrate --cameras FOLDER finds the poses"
        )
    notes = ["a stereo pair: X_right = R_r^T (R_l X_left + (Tx / fx', 0, 0)), metres; the rig's frame is the left "
             "camera's, unrectified"]  # fmt: skip
    if cut:
        notes.append(_note_cut(cut))
    if left.shift.any():
        notes.append("both files have Tx or Ty in P: their difference is used")
    if right.shift[0] > left.shift[0]:
        notes.append("Tx > 0: left and right seem to be swapped; used as it is")
    turned = nearest_rotation(right.rectified.T @ left.rectified, "R of the pair")
    translation = right.rectified.T @ (right.shift - left.shift)
    cameras = (
        replace(unplaced_camera(left.name, left.lens, left.image_size), places=left.places),
        ForeignCamera(
            right.name, right.lens, right.image_size, turned, translation, (*right.places, *_pair_places(left, right))
        ),
    )
    return ForeignRig(FORMAT.name, cameras, "m", f"camera {left.name}", tuple(notes), root=0)


def _pair_places(left: _Info, right: _Info) -> list[Place]:
    """Where the right camera's pose in the left one's frame stands: both rectifications and Tx."""
    if "r" not in left.keys or "r" not in right.keys or "p" not in right.keys:
        return []

    def tx(camera: ForeignCamera) -> list[float]:
        return [float(right.projection[0, 0] * (_rectification(camera, left.name)[2] + left.shift[0]))]

    return [
        Place(left.path, left.keys["r"], lambda camera: _rectification(camera, left.name)[0].ravel().tolist()),
        Place(right.path, right.keys["r"], lambda camera: _rectification(camera, left.name)[1].ravel().tolist()),
        Place(right.path, right.keys["p"], tx, first=3),
    ]


def _read_lenses(source: Source) -> list[ForeignCamera]:
    return [unplaced_camera(info.name, info.lens, info.image_size) for info in _infos(source)]


def _infos(source: Source) -> list[_Info]:
    return [_info(values, document) for document, values in source.mappings if _is_info(values)]


def _single(info: _Info) -> ForeignRig:
    pair = bool(info.shift.any()) or np.abs(info.rectified - np.eye(3)).max() > 1e-9
    note = "one camera: its own frame is the rig's" + (
        "; R and P are those of a stereo pair: give both files, or their folder, for the pair" if pair else ""
    )
    camera = replace(unplaced_camera(info.name, info.lens, info.image_size), places=info.places)
    notes = (note, _note_cut([info.name])) if info.cut else (note,)
    return ForeignRig(FORMAT.name, (camera,), "m", f"camera {info.name}", notes)


def _note_cut(names: list[str]) -> str:
    return (
        f"{name_cameras(names)}: the file has binning or a region of interest (roi): K and the size are those of the "
        "full image, and so is the rig; frames must be full images, too"
    )


def _is_cut(values: dict[str, Any], size: tuple[int, int] | None) -> bool:
    """Tell whether the images of a camera are binned or only a part, by values that may be anything."""
    roi = values.get("roi")
    roi = roi if isinstance(roi, dict) else {}
    sides = (roi.get("width") or 0, roi.get("height") or 0)
    binned = any((values.get(key) or 0) not in (0, 1) for key in ("binning_x", "binning_y"))
    return binned or bool(roi.get("x_offset") or roi.get("y_offset")) or sides not in ((0, 0), size)


def _info(values: dict[str, Any], document: Document) -> _Info:
    def get(key: str) -> Any:
        return next((values[name] for name in KEYS[key] if values.get(name) is not None), None)

    name = text(get("name") or document.path.stem, "camera_name")
    focal, centre, skew = camera_matrix(get("k"), f"{name}: camera_matrix")
    model = text(get("model") or "", f"{name}: distortion_model").lower()
    if model not in MODELS:
        raise FormatError(
            f"{name}: found the distortion_model {model!r}, expected one of {', '.join(filter(None, MODELS))}"
        )
    family, counts = MODELS[model]
    ks = coefficients(get("d"), f"{name}: distortion_coefficients", counts)
    lens = Lens(focal, centre, ks, family, skew)
    size = image_size([get("width") or 0, get("height") or 0], f"{name}: image_width, image_height")
    r, p = get("r"), get("p")
    rectified = (
        array(r, (3, 3), f"{name}: rectification_matrix") if r is not None and any(numbers(r, "R")) else np.eye(3)
    )
    nearest_rotation(rectified, f"{name}: rectification_matrix")
    plain = np.concatenate((lens.matrix, np.zeros((3, 1))), axis=1)
    projection = array(p, (3, 4), f"{name}: projection_matrix") if p is not None and any(numbers(p, "P")) else plain
    if projection[0, 0] <= 0 or projection[1, 1] <= 0:
        raise FormatError(
            f"{name}: projection_matrix: found the focal lengths {projection[0, 0]:g} and {projection[1, 1]:g}, "
            "expected positive ones"
        )
    keys: dict[str, tuple[str, ...]] = {}
    for key in "kdrp":
        found = next((one for one in KEYS[key] if values.get(one) is not None), None)
        if found is not None:
            keys[key] = (found, "data") if isinstance(values[found], dict) else (found,)
    return _Info(name, lens, size, rectified, projection, document.path, keys, _is_cut(values, size))


def _write(rig: ForeignRig) -> Files:
    if len(rig.cameras) == 1:
        camera = rig.cameras[0]
        return {
            _file_name(camera): _info_text(camera, np.eye(3), camera.lens.focal_length, camera.lens.principal_point)
        }
    left, right = rig.cameras
    of_left, of_right, shift = _rectification(right.in_frame_of(left), left.name)
    focal = float(min(*left.lens.focal_length, *right.lens.focal_length))
    width, height = left.image_size or (0, 0)
    centre = ((width - 1) / 2, (height - 1) / 2)
    return {
        _file_name(left): _info_text(left, of_left, (focal, focal), centre),
        _file_name(right): _info_text(right, of_right, (focal, focal), centre, focal * shift),
    }


def _rectification(right: ForeignCamera, left_name: str) -> tuple[Array, Array, float]:
    """The rotations of both cameras, (3, 3), and Tx / fx', of a right camera in the frame of the left one.

    Raises:
        FormatError: they do not stand side by side.
    """
    across = right.rotation.T @ right.translation  # minus the baseline, in the left camera
    # Rectified: x along the baseline to the right, z as near to both optical axes as that leaves free.
    x = -across / np.linalg.norm(across)
    turned_round = x[0] < 0
    x = -x if turned_round else x
    if abs(x[0]) < 0.5:
        raise FormatError(
            f"camera {right.name} is above, below, before or behind camera {left_name}, expected a stereo pair, "
            "side by side: choose another with --cameras"
        )
    ahead = np.array([0.0, 0.0, 1.0]) + right.rotation.T @ np.array([0.0, 0.0, 1.0])
    y = np.cross(ahead, x)
    y /= np.linalg.norm(y)
    of_left = np.stack((x, y, np.cross(x, y)))
    of_right = of_left @ right.rotation.T
    return of_left, of_right, float((of_left @ across)[0])


def _file_name(camera: ForeignCamera) -> str:
    return f"{Path(camera.name).name}.yaml"


def _info_text(
    camera: ForeignCamera, rectified: Array, focal: tuple[float, float], centre: tuple[float, float], tx: float = 0.0
) -> bytes:
    lens = camera.lens
    model, count = ("plumb_bob", 5) if lens.length <= 5 else ("rational_polynomial", 8)
    if lens.model == "fisheye":
        model, count = "equidistant", 4
    width, height = camera.image_size or (0, 0)
    projection = [focal[0], 0.0, centre[0], tx, 0.0, focal[1], centre[1], 0.0, 0.0, 0.0, 1.0, 0.0]

    def block(rows: int, columns: int, data: list[float]) -> dict[str, Any]:
        return {"rows": rows, "cols": columns, "data": Flow(data)}

    return yaml_text(
        {
            "image_width": width,
            "image_height": height,
            "camera_name": camera.name,
            "camera_matrix": block(3, 3, lens.matrix.ravel().tolist()),
            "distortion_model": model,
            "distortion_coefficients": block(1, count, lens.pad(count)),
            "rectification_matrix": block(3, 3, rectified.ravel().tolist()),
            "projection_matrix": block(3, 4, projection),
        }
    ).encode()


FORMAT = Format(
    "ros", TITLE, _recognizes, _read, _write, Holds((5, 8), fisheye=True), states_unit=True,
    from_first=True, cameras=(1, 2), read_lenses=_read_lenses,
)  # fmt: skip
