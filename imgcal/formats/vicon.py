"""Vicon `.xcp`: XML, millimetres. ORIENTATION is the quaternion x, y, z, w of cam_from_world, POSITION the centre.

Checked on a real calibration: the quaternion is that of OpenCV's axes (x right, y down, z forward), and a shift of the
principal point of 0 fits best. Which axis is up differs from file to file. The distortion takes a point of the image
to where a pinhole would have put it, with k in powers of pixels: its numbers are not OpenCV's.
Another lens model takes its place by a fit.
"""

from __future__ import annotations

from pathlib import Path

from imgcal.formats import places
from imgcal.formats.documents import Element
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.format import Format
from imgcal.formats.lens import Lens
from imgcal.formats.source import Source
from imgcal.formats.values import (
    array,
    attribute,
    focal_length,
    image_size,
    number,
    numbers,
    rotation_from_quaternion,
)
from imgcal.messages import name_cameras

TITLE = "Vicon calibration (.xcp)"


def _recognizes(source: Source) -> bool:
    return any(root.all("KeyFrame") or root.all("Camera") for root in source.roots("Cameras"))


def _read(source: Source) -> ForeignRig:
    document = next(one for one in source.documents if one.kind == "xml" and one.value.tag == "Cameras")
    root = document.value
    cameras: list[ForeignCamera] = []
    lost: list[str] = []
    several: list[str] = []
    for element in root.all("Camera"):
        name = element.attributes.get("DEVICEID") or element.attributes.get("USERID") or str(len(cameras) + 1)
        frames = [frame for frame in element.all("KeyFrame") if "POSITION" in frame.attributes]
        if not frames:
            lost.append(name)
            continue
        if len(frames) > 1:
            several.append(name)
        cameras.append(_camera(name, element, frames[0], document.path))
    if not cameras:
        raise FormatError("no camera has a KeyFrame with a pose: it was never calibrated")
    notes = [
        "millimetres; which axis is up is not in the file",
        "distortion: from the image to the ideal, in pixels (VICON_RADIAL2 or VICON_RADIAL); other formats get a fit",
        "pixel centres are assumed at whole numbers: not documented, but a real calibration fits best so",
    ]
    if lost:
        notes.append(f"{name_cameras(lost)}: left out, without a KeyFrame")
    if several:
        notes.append(f"{name_cameras(several)}: moves (several KeyFrames); the first is used")
    return ForeignRig(FORMAT.name, tuple(cameras), "mm", "Vicon's world", tuple(notes))


def _camera(name: str, element: Element, frame: Element, path: Path) -> ForeignCamera:
    def get(key: str) -> str:
        return attribute(frame, key, name)

    aspect = number(element.attributes.get("PIXEL_ASPECT_RATIO", "1"), f"{name}: PIXEL_ASPECT_RATIO")
    if not 0.1 <= aspect <= 10:
        raise FormatError(f"{name}: PIXEL_ASPECT_RATIO: found {aspect:g}, expected near 1")
    along = number(get("FOCAL_LENGTH"), f"{name}: FOCAL_LENGTH")
    focal = focal_length(along, along / aspect, f"{name}: FOCAL_LENGTH")
    x, y = array(get("PRINCIPAL_POINT"), (2,), f"{name}: PRINCIPAL_POINT").tolist()
    skew = number(element.attributes.get("SKEW", "0"), f"{name}: SKEW")
    ks = _distortion(name, frame, (x, y))
    sensor = element.attributes.get("SENSOR_SIZE")
    size = image_size(numbers(sensor, name), f"{name}: SENSOR_SIZE") if sensor else None
    quaternion = numbers(get("ORIENTATION"), f"{name}: ORIENTATION")
    rotation = rotation_from_quaternion([*quaternion[3:], *quaternion[:3]], f"{name}: ORIENTATION")
    centre = array(get("POSITION"), (3,), f"{name}: POSITION")
    lens = Lens(focal, (x, y), ks, "to_ideal", skew)
    found = _places(path, element, frame, quaternion)
    return ForeignCamera(name, lens, size, rotation, -rotation @ centre, tuple(found))


def _places(path: Path, element: Element, frame: Element, quaternion: list[float]) -> list[Place]:
    """Where the camera's numbers stand; both distortions are the same lens, one of them with a centre of its own."""

    def orientation(camera: ForeignCamera) -> list[float]:
        w, *xyz = places.near_quaternion(camera.rotation, [quaternion[3], *quaternion[:3]])
        return [*xyz, w]

    def with_centre(camera: ForeignCamera) -> list[float]:
        k1, k2, k3, x, y = camera.lens.pad(5)
        return [camera.lens.principal_point[0] + x, camera.lens.principal_point[1] + y, k1, k2, k3]

    fixed: dict[str, places.Numbers] = {
        "PIXEL_ASPECT_RATIO": lambda camera: [camera.lens.focal_length[0] / camera.lens.focal_length[1]],
        "SKEW": lambda camera: [camera.lens.skew],
    }
    moving: dict[str, places.Numbers] = {
        "FOCAL_LENGTH": lambda camera: [camera.lens.focal_length[0]],
        "PRINCIPAL_POINT": lambda camera: camera.lens.principal_point,
        "ORIENTATION": orientation,
        "POSITION": places.centre,
        "VICON_RADIAL2": with_centre,
        "VICON_RADIAL": places.coefficients(len(frame.attributes.get("VICON_RADIAL", "").split())),
    }
    return [*places.attributes(path, element, fixed), *places.attributes(path, frame, moving)]


def _distortion(name: str, frame: Element, centre: tuple[float, float]) -> tuple[float, ...]:
    """k1, k2, k3 in pixels; VICON_RADIAL2 has a centre of its own, too."""
    second, first = frame.attributes.get("VICON_RADIAL2"), frame.attributes.get("VICON_RADIAL")
    if second:
        found = numbers(" ".join(second.split()[1:]), f"{name}: VICON_RADIAL2")
        if len(found) < 4:
            raise FormatError(f"{name}: VICON_RADIAL2: found {len(found)} numbers, expected a centre and coefficients")
        ks = (*found[2:5], 0.0, 0.0)[:3]
        return (*ks, found[0] - centre[0], found[1] - centre[1]) if any(ks) else (0.0, 0.0, 0.0)
    found = numbers(first, f"{name}: VICON_RADIAL") if first else []
    return tuple(found[:3])


FORMAT = Format("vicon", TITLE, _recognizes, _read, states_unit=True)
