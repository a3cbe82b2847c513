"""OptiTrack Motive `.mcal` (Motive 3.2 and newer): XML, metres, y up; camera axes x right, y up, looking along -z.

The direction of its distortion polynomial is not documented. Public readers take it as OpenCV's (ideal to distorted),
and so does this one; the signs of real files hint at the other. The two differ by tens of pixels in the corners.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imgcal.formats import places
from imgcal.formats.documents import Element
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.format import Format
from imgcal.formats.lens import Lens
from imgcal.formats.source import Source
from imgcal.formats.values import attribute, focal_length, image_size, nearest_rotation, number
from imgcal.messages import name_cameras

TITLE = "OptiTrack Motive calibration (.mcal)"
COEFFICIENTS = ("k1", "k2", "TangentialX", "TangentialY", "k3")  # in OpenCV's order
UPWARD = np.diag([1.0, -1.0, -1.0])


def _recognizes(source: Source) -> bool:
    return any(root.all("IntrinsicStandardCameraModel") or root.all("Extrinsic") for root in source.roots())


def _read(source: Source) -> ForeignRig:
    found = [one for one in source.documents if isinstance(one.value, Element)]
    document = next(one for one in found if one.value.all("Extrinsic") or one.value.all("Camera"))
    root = document.value
    cameras: list[ForeignCamera] = []
    lost: list[str] = []
    for element in root.all("Camera"):
        name = element.attributes.get("Serial", str(len(cameras) + len(lost) + 1))
        pose, lens = element.find("Extrinsic"), element.find("IntrinsicStandardCameraModel")
        if pose is None or lens is None:
            lost.append(name)
            continue
        cameras.append(_camera(name, element, pose, lens, document.path))
    if not cameras:
        raise FormatError("no camera has Extrinsic and IntrinsicStandardCameraModel")
    notes = [
        "metres, y up",
        "UNCONFIRMED: Motive does not document the direction of its distortion; read as OpenCV's. If the corners of "
        "images disagree by tens of pixels, it is the opposite: the poses are right, the distortion is not",
        "whether pixel centres lie at 0 or 0.5 is not documented: up to half a pixel is open",
    ]
    if lost:
        notes.append(f"{name_cameras(lost)}: left out, not calibrated")
    return ForeignRig(FORMAT.name, tuple(cameras), "m", "Motive's world (y up)", tuple(notes))


def _camera(name: str, element: Element, pose: Element, model: Element, path: Path) -> ForeignCamera:
    def get(of: Element, key: str) -> float:
        return number(attribute(of, key, name), f"{name}: {key}")

    focal = focal_length(get(model, "HorizontalFocalLength"), get(model, "VerticalFocalLength"), name)
    ks = [get(model, key) for key in COEFFICIENTS]
    lens = Lens(focal, (get(model, "LensCenterX"), get(model, "LensCenterY")), tuple(ks))
    axes = np.array([get(pose, f"OrientMatrix{n}") for n in range(9)]).reshape(3, 3)
    world_from_camera = nearest_rotation(axes, f"{name}: OrientMatrix")
    rotation = UPWARD @ world_from_camera.T
    centre = np.array([get(pose, axis) for axis in "XYZ"])
    attributes = element.find("Attributes")
    size = None
    if attributes is not None:
        size = image_size([get(attributes, "ImagerPixelWidth"), get(attributes, "ImagerPixelHeight")], name)
    return ForeignCamera(name, lens, size, rotation, -rotation @ centre, _places(path, pose, model))


def _places(path: Path, pose: Element, model: Element) -> tuple[Place, ...]:
    def orientation(camera: ForeignCamera) -> list[float]:
        return (UPWARD @ camera.rotation).T.ravel().tolist()

    keys = ("HorizontalFocalLength", "VerticalFocalLength", "LensCenterX", "LensCenterY")
    inside = {key: places.entry(places.focal_and_centre, place) for place, key in enumerate(keys)}
    inside |= {key: places.entry(places.coefficients(5), place) for place, key in enumerate(COEFFICIENTS)}
    outside = {axis: places.entry(places.centre, place) for place, axis in enumerate("XYZ")}
    outside |= {f"OrientMatrix{place}": places.entry(orientation, place) for place in range(9)}
    return (*places.attributes(path, pose, outside), *places.attributes(path, model, inside))


FORMAT = Format("motive", TITLE, _recognizes, _read, states_unit=True)
