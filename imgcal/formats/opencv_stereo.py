"""OpenCV stereo pairs: `intrinsics.yml` and `extrinsics.yml` of `stereo_calib`, and what others write with its keys.

X2 = R X1 + T in the unit of the board that was used, which no file says; nor do they say the size of the images.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from imgcal.formats import places
from imgcal.formats.file_storage import is_matrix, key_place, merge_storages, storage_text
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.format import Files, Format
from imgcal.formats.lens import Lens
from imgcal.formats.source import Source
from imgcal.formats.values import array, camera_matrix, coefficients, image_size, number, numbers, rotation

TITLE = "OpenCV stereo pair (FileStorage)"

# Keys as they are met, without case, dots, dashes and underscores; a side is 1 or 2, l or r, left or right.
MATRIX = ("m", "k", "cameramatrix", "cammatrix", "cammat", "mtx", "intrinsic", "intrinsics", "cam", "camera", "km")
DISTORTION = ("d", "dist", "distcoeffs", "distcoeff", "distcoefs", "distcoef", "distortion", "distortioncoefficients",
              "distortioncoeffs", "kc")  # fmt: skip
ROTATION = ("r", "rotation", "rotationmatrix", "rmat", "stereor", "rlr")
TRANSLATION = ("t", "translation", "translationvector", "tvec", "stereot", "tlr")
SIZE = ("imagesize", "size", "imgsize", "resolution", "framesize", "imageshape")
SIDES = (("1", "l", "left", "0"), ("2", "r", "right", "1"))


def _recognizes(source: Source) -> bool:
    keys = _keys(merge_storages(source))
    return len(_sides(keys, MATRIX)) == 2 or (
        _first(keys, ROTATION) is not None and _first(keys, TRANSLATION) is not None
        and {"q", "p1", "p2"} & keys.keys() != set()
    )  # fmt: skip


def _read(source: Source) -> ForeignRig:
    keys = _keys(merge_storages(source))
    matrix_keys, distortion_keys = _sides(keys, MATRIX), _sides(keys, DISTORTION)
    matrices, distortions = [keys[key] for key in matrix_keys], [keys[key] for key in distortion_keys]
    turn, shift = _first(keys, ROTATION), _first(keys, TRANSLATION)
    if len(matrices) < 2:
        raise FormatError(
            "found only extrinsics (R, T): give the file with M1, D1, M2, D2 as well, or the folder of both"
        )
    if turn is None or shift is None:
        raise FormatError(
            "found only intrinsics (no R, T): give the file with the extrinsics as well, or the folder of both"
        )
    size = image_size(_first(keys, SIZE), "image size")
    if size is None and "imagewidth" in keys and "imageheight" in keys:
        size = image_size([keys["imagewidth"], keys["imageheight"]], "image size")
    fisheye = any(number(keys[key], key) != 0 for key in ("fisheye", "isfisheye", "fisheyemodel") if key in keys)
    notes = ["X2 = R X1 + T: the rig's frame is that of camera 1, unrectified; R1, R2, P1, P2, Q are not used"]
    lenses = []
    for side, k in enumerate(matrices):
        d = distortions[side] if len(distortions) == 2 else None
        focal, centre, skew = camera_matrix(k, f"camera matrix {side + 1}")
        ks = coefficients(d, f"distortion {side + 1}", counts=(4,) if fisheye else (0, 4, 5, 8, 12, 14))
        lenses.append(Lens(focal, centre, ks, "fisheye" if fisheye else "opencv", skew))
    if len(distortions) != 2:
        notes.append("no distortion in the file: assumed to be zero")
    elif not fisheye and all(len(lens.coefficients) == 4 for lens in lenses):
        notes.append("4 coefficients are read as k1 k2 p1 p2; those of cv2.fisheye look alike: compare with an image")
    turned, translation = rotation(turn, "R"), array(shift, (3,), "T")
    if translation[0] > 0:
        notes.append("T[0] > 0: camera 2 is to the left of camera 1; used as it is")
    poses = ((np.eye(3), np.zeros(3)), (turned, translation))
    written = {_letters_and_digits(key): key for key in reversed(list(merge_storages(source)))}

    def place(key: str, of: places.Numbers) -> Place:
        return Place(*key_place(source, written[key]), of)

    cameras = []
    for side, (lens, pose) in enumerate(zip(lenses, poses, strict=True)):
        found = [place(matrix_keys[side], places.camera_matrix)]
        if len(distortion_keys) == 2:
            found.append(place(distortion_keys[side], places.coefficients(len(lens.coefficients))))
        if side:
            found.append(place(_first_key(keys, ROTATION), places.rotation_like(numbers(turn, "R"))))
            found.append(place(_first_key(keys, TRANSLATION), places.translation))
        cameras.append(ForeignCamera(str(side + 1), lens, size, *pose, tuple(found)))
    return ForeignRig(FORMAT.name, tuple(cameras), None, "camera 1", tuple(notes), root=0)


def _write(rig: ForeignRig) -> Files:
    first, second = rig.cameras
    intrinsics: dict[str, Any] = {}
    for side, camera in enumerate(rig.cameras, start=1):
        count = next(count for count in (5, 8, 12, 14) if count >= camera.lens.length)
        intrinsics[f"M{side}"] = camera.lens.matrix
        intrinsics[f"D{side}"] = np.array([camera.lens.pad(count)])
    if first.image_size == second.image_size and first.image_size is not None:
        intrinsics["image_width"], intrinsics["image_height"] = first.image_size
    extrinsics = {"R": second.rotation, "T": second.translation[:, None]}
    return {"intrinsics.yml": storage_text(intrinsics), "extrinsics.yml": storage_text(extrinsics)}


def _keys(values: dict[str, Any]) -> dict[str, Any]:
    plain: dict[str, Any] = {}
    for key, value in values.items():
        plain.setdefault(_letters_and_digits(key), value)
    return plain


def _letters_and_digits(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _first(keys: dict[str, Any], names: tuple[str, ...]) -> Any:
    return keys.get(_first_key(keys, names))


def _first_key(keys: dict[str, Any], names: tuple[str, ...]) -> str:
    return next((name for name in names if name in keys), "")


def _sides(keys: dict[str, Any], names: tuple[str, ...]) -> list[str]:
    """The keys of the first and the second camera; fewer where the file has no such pair."""
    for ours, theirs in zip(*SIDES, strict=True):
        for name in names:
            for one, other in ((name + ours, name + theirs), (ours + name, theirs + name)):
                if is_matrix(keys.get(one)) and is_matrix(keys.get(other)):
                    return [one, other]
    return []


FORMAT = Format(
    "opencv-stereo", TITLE, _recognizes, _read, _write, Holds((5, 8, 12, 14)), unit="mm", from_first=True,
    cameras=(2, 2), numbers_cameras=True,
)  # fmt: skip
