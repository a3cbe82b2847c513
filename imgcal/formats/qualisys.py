"""Qualisys QTM calibration (XML in .qca.txt, .xml): mm, intrinsics in 1/64 pixel, camera axes x right, y up, -z ahead.

Distortion is dimensionless, in OpenCV's order and direction. Whether centre / 64 counts from a pixel's centre or corner
is not documented: up to half a pixel is open. Theia3D writes the same elements with plain pixels and X_cam = r X + p.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imgcal.formats import places
from imgcal.formats.documents import Element
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError
from imgcal.formats.format import Format
from imgcal.formats.lens import Array, Lens
from imgcal.formats.source import Source
from imgcal.formats.values import attribute, focal_length, nearest_rotation, number
from imgcal.messages import name_cameras

TITLE = "Qualisys calibration"
FRACTION = 64.0
FEWEST = 250  # pixels across of any of their cameras: a smaller span is one of plain pixels
UPWARD = np.diag([1.0, -1.0, -1.0])  # OpenCV's camera from one that has y up and looks along -z


def _recognizes(source: Source) -> bool:
    return any(root.find("cameras") is not None and root.all("transform") for root in source.roots("calibration"))


def _read(source: Source) -> ForeignRig:
    document = next(one for one in source.documents if one.kind == "xml" and one.value.tag == "calibration")
    root = document.value
    cameras: list[ForeignCamera] = []
    lost: list[str] = []
    turned: list[str] = []
    theia = False
    for element in root.all("camera"):
        name = element.attributes.get("serial") or f"camera {len(cameras) + len(lost) + 1}"
        transform, intrinsic = element.find("transform"), element.find("intrinsic")
        if transform is None or intrinsic is None or element.attributes.get("active") == "0":
            lost.append(name)
            continue
        if element.attributes.get("viewrotation", "0") not in ("0", ""):
            turned.append(name)
        camera, plain = _camera(name, element, transform, intrinsic, document.path)
        theia |= plain
        cameras.append(camera)
    if not cameras:
        raise FormatError("no active camera has a transform and intrinsics")
    notes = ["millimetres, z up"]
    if theia:
        notes.append("plain pixels: read as Theia3D's variant (X_cam = r X + p)")
    else:
        notes.append("QTM does not document whether its pixel centres lie at 0 or 0.5: up to half a pixel is open")
    if lost:
        notes.append(f"{name_cameras(lost)}: left out, not active or not calibrated")
    if turned:
        notes.append(
            f"{name_cameras(turned)}: mounted rotated (viewrotation): the numbers refer to the sensor's own image, "
            "before a video is rotated upright"
        )
    return ForeignRig(FORMAT.name, tuple(cameras), "mm", "QTM's world (z up)", tuple(notes))


def _camera(
    name: str, element: Element, transform: Element, intrinsic: Element, path: Path
) -> tuple[ForeignCamera, bool]:
    def get(key: str, of: Element = intrinsic) -> float:
        return number(attribute(of, key, name), f"{name}: {key}")

    view = element.find("fov_video") or element.find("fov_marker") or element.find("fov_video_max")
    span = get("sensorMaxU") - get("sensorMinU"), get("sensorMaxV") - get("sensorMinV")
    plain = abs(span[0]) < FRACTION * FEWEST
    fraction = 1.0 if plain else FRACTION
    if view is None:
        left, top, width, height = 0.0, 0.0, span[0] / fraction + 1, span[1] / fraction + 1
    else:
        left, top = get("left", view), get("top", view)
        width, height = get("right", view) - left + 1, get("bottom", view) - top + 1
    if not 1 <= width <= 2**16 or not 1 <= height <= 2**16:
        raise FormatError(f"{name}: found an image of {width:g} x {height:g} pixels, expected 1 to {2**16}")
    focal = focal_length(get("focalLengthU") / fraction, get("focalLengthV") / fraction, name)
    centre = get("centerPointU") / fraction - left, get("centerPointV") / fraction - top
    word = "tangential" if "tangentialDistortion1" in intrinsic.attributes else "tangental"
    keys = ("radialDistortion1", "radialDistortion2", f"{word}Distortion1", f"{word}Distortion2", "radialDistortion3")
    lens = Lens(focal, centre, tuple(get(key) for key in keys), "opencv", get("skew") / fraction)
    place = np.array([get(axis, transform) for axis in "xyz"])
    axes: Array = np.array([[get(f"r{row}{column}", transform) for column in (1, 2, 3)] for row in (1, 2, 3)])
    axes = nearest_rotation(axes, f"{name}: transform")
    rotation, translation = (axes, place) if plain else (UPWARD @ axes, -UPWARD @ axes @ place)

    def axes_of(camera: ForeignCamera) -> list[float]:
        return (camera.rotation if plain else UPWARD @ camera.rotation).ravel().tolist()

    inside = {key: places.entry(places.coefficients(5), which) for which, key in enumerate(keys)}
    for which, (key, shift) in enumerate(
        (("focalLengthU", 0.0), ("focalLengthV", 0.0), ("centerPointU", left), ("centerPointV", top))
    ):
        inside[key] = places.entry(places.focal_and_centre, which, fraction, shift)
    inside["skew"] = lambda camera: [camera.lens.skew * fraction]
    if "focallength" in intrinsic.attributes:
        millimetres = get("focallength") / focal[0]
        inside["focallength"] = places.entry(places.focal_and_centre, 0, millimetres)
    outside = {
        axis: places.entry(places.translation if plain else places.centre, which) for which, axis in enumerate("xyz")
    }
    outside |= {f"r{which // 3 + 1}{which % 3 + 1}": places.entry(axes_of, which) for which in range(9)}
    found = (*places.attributes(path, transform, outside), *places.attributes(path, intrinsic, inside))
    return ForeignCamera(name, lens, (round(width), round(height)), rotation, translation, found), plain


FORMAT = Format("qualisys", TITLE, _recognizes, _read, states_unit=True)
