"""COLMAP's model: cameras, images, rigs and frames, whether they come as text or as binary.

Pixel (0.5, 0.5) is the centre of the top-left pixel there: principal points move by half a pixel. The unit is arbitrary
unless the model has been given a scale.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path, PurePosixPath

import numpy as np

from imgcal.formats import places
from imgcal.formats.chains import IDENTITY, Link, Pose, compose, find_linked, inverse
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.lens import Array, Lens, Model
from imgcal.formats.values import quaternion_from_rotation, rotation_from_quaternion
from imgcal.messages import name_cameras, plural, shorten

HALF = 0.5
MODELS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip
"""In the order of their numbers in binary files."""

COUNTS = dict(zip(MODELS, (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16), strict=True))
ROTATION_STEADY, PLACE_STEADY = 1e-3, 1e-2  # rad; of the cameras' distances to each other


@dataclass(frozen=True)
class At:
    """Where numbers stand in a file: the line, or the offset in bytes, and how many numbers of the line come before."""

    path: Path
    line: int
    first: int = 0

    def place(self, numbers: places.Numbers) -> Place:
        """The place of numbers of a camera."""
        return Place(self.path, (self.line,), numbers, self.first)


@dataclass(frozen=True)
class ColmapCamera:
    """A row of cameras.txt."""

    id: int
    model: str
    image_size: tuple[int, int] | None
    parameters: tuple[float, ...]
    at: At | None = None

    @property
    def one_focal_length(self) -> bool:
        """Tell whether fx and fy are one number."""
        return self.model.startswith(("SIMPLE", "RADIAL"))

    def numbers(self, camera: ForeignCamera) -> list[float]:
        """The parameters of a camera of this model."""
        fx, fy, cx, cy = places.focal_and_centre(camera)
        focal = [fx] if self.one_focal_length else [fx, fy]
        return [*focal, cx + HALF, cy + HALF, *camera.lens.pad(len(self.parameters) - len(focal) - 2)]

    def camera(self, name: str, pose: Pose, *others: Place) -> ForeignCamera:
        """The camera, where it stands."""
        found = (self.at.place(self.numbers), *others) if self.at is not None else others
        return ForeignCamera(name, self.lens(), self.image_size, *pose, found, self.one_focal_length)

    def lens(self) -> Lens:
        """The lens with OpenCV's pixels."""
        if self.model not in COUNTS or self.model in ("FOV", *MODELS[10:]):
            raise FormatError(f"camera {self.id}: the model {self.model} has no counterpart in other tools")
        if len(self.parameters) != COUNTS[self.model]:
            raise FormatError(
                f"camera {self.id}: found {len(self.parameters)} parameters, {self.model} has {COUNTS[self.model]}"
            )
        p = self.parameters
        if self.one_focal_length:
            focal, centre, ks = (p[0], p[0]), (p[1], p[2]), p[3:]
        else:
            focal, centre, ks = (p[0], p[1]), (p[2], p[3]), p[4:]
        if min(focal) <= 0:
            raise FormatError(f"camera {self.id}: found the focal length {min(focal):g}, expected a positive one")
        model: Model = "fisheye" if self.model.endswith("FISHEYE") else "opencv"
        return Lens(focal, (centre[0] - HALF, centre[1] - HALF), tuple(ks), model)


@dataclass(frozen=True)
class ColmapImage:
    """A row of images.txt: cam_from_world."""

    id: int
    pose: Pose
    camera: int
    name: str
    at: At | None = None

    def place(self, before: Pose) -> list[Place]:
        """Where its pose stands, which goes along with its camera."""
        return [self.at.place(places.carry_pose(before, self.pose, places.pose_numbers))] if self.at is not None else []


@dataclass(frozen=True)
class ColmapRig:
    """A row of rigs.txt: sensor_from_rig of each camera; None where the file has no pose."""

    id: int
    sensors: dict[int, Pose | None]
    at: dict[int, At] = field(default_factory=dict)  # of the poses


def pose_from_quaternion(row: Sequence[float], what: str) -> Pose:
    """A quaternion w, x, y, z (Hamilton) and a translation."""
    return rotation_from_quaternion(list(row[:4]), what), np.array(row[4:7], dtype=np.float64)


def rig_from_model(
    name: str,
    cameras: Sequence[ColmapCamera],
    images: Sequence[ColmapImage],
    rigs: Sequence[ColmapRig],
    wanted: str | None = None,
) -> ForeignRig:
    """Make a rig: of a rig that the model has, else of the images that were taken together.

    Raises:
        FormatError: neither is there, or the cameras were not fixed to each other.
    """
    known = {camera.id: camera for camera in cameras}
    notes = ["COLMAP's pixels begin half a pixel earlier: cx and cy are smaller by 0.5 here"]
    together = [rig for rig in rigs if len(rig.sensors) > 1]
    if together:
        chosen = together[chosen_rig(_rig_names(together, images), wanted)]
        return _convert_rig(name, chosen, known, images, notes)
    return _convert_images(name, known, images, notes)


def chosen_rig(names: Sequence[str], wanted: str | None) -> int:
    """Find the rig that the user means.

    Raises:
        FormatError: there are several and none is named, or there is none of that name.
    """
    if wanted is None and len(names) > 1:
        raise FormatError(f"found {len(names)} rigs ({', '.join(names[:8])}): choose one with imgcal convert "
                          f"--source-rig {names[0]}")  # fmt: skip
    if wanted is not None and wanted not in names:
        raise FormatError(f"--source-rig: found {shorten(wanted)}, expected one of {', '.join(names[:8])}")
    return 0 if wanted is None else list(names).index(wanted)


def _rig_names(rigs: Sequence[ColmapRig], images: Sequence[ColmapImage]) -> list[str]:
    """Rigs are called as the folder of their images, where each has one of its own, else by their numbers."""
    names = []
    for rig in rigs:
        folders = [PurePosixPath(image.name).parts[:-1] for image in images if image.camera in rig.sensors]
        names.append("/".join(common_prefix(folders)))
    return names if all(names) and len(set(names)) == len(names) else [str(rig.id) for rig in rigs]


def common_prefix(folders: Sequence[Sequence[str]]) -> list[str]:
    """What several folders have in common at their beginning."""
    common = []
    for parts in zip(*folders, strict=False):
        if len(set(parts)) > 1:
            break
        common.append(parts[0])
    return common


def _names(rig: ColmapRig, images: Sequence[ColmapImage]) -> dict[int, str]:
    """Cameras are called as the folders of their images, where each has one of its own, else by their numbers."""
    folders: dict[int, set[str]] = {sensor: set() for sensor in rig.sensors}
    for image in images:
        if image.camera in folders:
            folders[image.camera].add(str(PurePosixPath(image.name).parent))
    one_each = [next(iter(found)) for found in folders.values() if len(found) == 1]
    names = [folder.rpartition("/")[2] for folder in one_each]
    if len(set(names)) == len(folders) and "." not in names:
        return dict(zip(folders, names, strict=True))
    return {sensor: str(sensor) for sensor in rig.sensors}


def _convert_rig(
    name: str, rig: ColmapRig, known: dict[int, ColmapCamera], images: Sequence[ColmapImage], notes: list[str]
) -> ForeignRig:
    names = _names(rig, images)
    lost = [names[sensor] for sensor, pose in rig.sensors.items() if pose is None]
    if lost:
        notes.append(f"{name_cameras(lost)}: left out, without a pose in the rig")
    found: list[ForeignCamera] = []
    root = None
    for sensor, pose in rig.sensors.items():
        if pose is None:
            continue
        if sensor not in known:
            raise FormatError(f"rig {rig.id}: camera {sensor} is not among the cameras")
        if pose is IDENTITY:
            root = len(found)
        others = [place for image in images if image.camera == sensor for place in image.place(pose)]
        if sensor in rig.at:
            others.append(rig.at[sensor].place(places.pose_numbers))
        found.append(known[sensor].camera(names[sensor], pose, *others))
    if len(found) < 2:
        raise FormatError(f"rig {rig.id}: {name_cameras(lost)} without a pose in it; a rig needs two or more")
    return ForeignRig(name, tuple(found), None, f"rig {rig.id} (its reference camera)", tuple(notes), root=root)


def _convert_images(
    name: str, known: dict[int, ColmapCamera], images: Sequence[ColmapImage], notes: list[str]
) -> ForeignRig:
    if len(images) < 2:
        raise FormatError(
            f"found no rig and {len(images)} images, expected rigs.txt or images that were taken together"
        )
    frames: dict[str, dict[str, ColmapImage]] = {}
    folders = {str(PurePosixPath(image.name).parent) for image in images}
    for image in images:
        path = PurePosixPath(image.name)
        frame, camera = (path.stem, str(path.parent)) if len(folders) > 1 else ("", path.stem)
        if camera in frames.setdefault(frame, {}):
            raise FormatError(f"found two images of {camera} in one frame: {image.name}")
        frames[frame][camera] = image
    intrinsics = len({image.camera for image in images})
    if len(folders) == 1 and intrinsics < len(images):
        notes.append(
            f"found no rigs.txt, and {len(images)} images in one folder with {plural(intrinsics, 'set')} of "
            "intrinsics: treated as that many cameras at one moment, which is wrong if a camera has several images: "
            "then it needs rigs.txt, or a folder for each camera with one file name for each moment"
        )
    frames = dict(sorted(frames.items(), key=lambda item: -len(item[1])))  # the fullest first
    frame, first = next(iter(frames.items()))
    root = next(iter(first))
    poses = find_linked(root, _links(frames.values()))
    if len(poses) < 2:
        raise FormatError("found no rig, and no two cameras with images of one moment (of one name in each folder)")
    _check_steady(frames, poses)
    if len(frames) > 1:
        linked = [camera for camera in poses if camera not in first]
        through = f"; {name_cameras(linked)}: linked through other images" if linked else ""
        notes.append(f"found no rigs.txt: the cameras' poses are those of the images {frame!r} of each folder{through}")
    if lost := [camera for camera in dict.fromkeys(chain.from_iterable(frames.values())) if camera not in poses]:
        notes.append(f"{name_cameras(lost)}: left out, no image that links it to {root}")
    cameras = []
    for camera, pose in poses.items():
        taken = [images_of[camera] for images_of in frames.values() if camera in images_of]
        row = known.get(taken[0].camera)
        if row is None:
            raise FormatError(f"image {taken[0].name}: camera {taken[0].camera} is not among the cameras")
        placed = compose(pose, first[root].pose)
        others = [place for image in taken for place in image.place(placed)]
        cameras.append(row.camera(camera, placed, *others))
    return ForeignRig(name, tuple(cameras), None, "COLMAP's world" + (f" at {frame!r}" if frame else ""), tuple(notes))


def _links(frames: Iterable[dict[str, ColmapImage]]) -> list[Link]:
    """Link the cameras of each frame to its first one."""
    links = []
    for images in frames:
        (base, first), *others = images.items()
        links += [Link(camera, base, compose(image.pose, inverse(first.pose))) for camera, image in others]
    return links


def _check_steady(frames: dict[str, dict[str, ColmapImage]], poses: dict[str, Pose]) -> None:
    """The cameras must stand to each other in every frame as their poses say."""
    size = max(float(np.linalg.norm(pose[1])) for pose in poses.values())
    for frame, images in frames.items():
        placed = [camera for camera in poses if camera in images]
        for camera in placed[1:]:
            now = compose(images[camera].pose, inverse(images[placed[0]].pose))
            then = compose(poses[camera], inverse(poses[placed[0]]))
            turned = float(np.abs(now[0] - then[0]).max())
            moved = float(np.linalg.norm(now[1] - then[1]))
            if turned > ROTATION_STEADY or moved > PLACE_STEADY * size:
                raise FormatError(
                    f"found no rigs.txt, and camera {camera} has another pose relative to {placed[0]} in {frame!r}: "
                    "the cameras are not fixed to each other, or the model was made without a rig (see COLMAP's "
                    "rig_configurator)"
                )


def model_from_rig(rig: ForeignRig) -> tuple[list[ColmapCamera], list[ColmapImage], ColmapRig, Pose]:
    """Take a rig apart for writing: cameras, an image each, the rig (first camera = reference), and rig_from_world."""
    first = (rig.cameras[0].rotation, rig.cameras[0].translation)
    cameras, images, sensors = [], [], dict[int, Pose | None]()
    for number, camera in enumerate(rig.cameras, start=1):
        pose = (camera.rotation, camera.translation)
        cameras.append(_row(number, camera))
        images.append(ColmapImage(number, pose, number, f"{camera.name}/0.png"))
        sensors[number] = IDENTITY if number == 1 else compose(pose, inverse(first))
    return cameras, images, ColmapRig(1, sensors), first


def _row(number: int, camera: ForeignCamera) -> ColmapCamera:
    lens = camera.lens
    (fx, fy), (cx, cy) = lens.focal_length, lens.principal_point
    start = (fx, fy, cx + HALF, cy + HALF)
    if lens.model == "fisheye":
        return ColmapCamera(number, "OPENCV_FISHEYE", camera.image_size, (*start, *lens.pad(4)))
    if lens.length == 0:
        return ColmapCamera(number, "PINHOLE", camera.image_size, start)
    if lens.length <= 4:
        return ColmapCamera(number, "OPENCV", camera.image_size, (*start, *lens.pad(4)))
    return ColmapCamera(number, "FULL_OPENCV", camera.image_size, (*start, *lens.pad(8)))


def pose_numbers(pose: Pose) -> Array:
    """A pose as COLMAP writes it: quaternion w, x, y, z and translation."""
    return np.concatenate((quaternion_from_rotation(pose[0]), pose[1]))
