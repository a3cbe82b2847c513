"""`load_rig`: of our own files, of shipped rigs, and of every format of another tool."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from imgcal import io
from imgcal.errors import InputError
from imgcal.formats.conversion import NATIVE, fill_image_sizes, fit_to_target, in_millimetres, to_camera_rig
from imgcal.formats.foreign_rig import ForeignRig
from imgcal.formats.limits import LIMIT
from imgcal.formats.registry import is_foreign, read_foreign_lenses, read_foreign_rig
from imgcal.types import CameraRig

Size = tuple[int, int]


def load_rig(
    path: str | Path,
    *,
    unit: str | None = None,
    image_size: Size | Mapping[str, Size] | None = None,
    format: str | None = None,
    fit_limit: float = LIMIT,
) -> CameraRig:
    """Read a rig: a YAML file of our own, the bare name of a shipped rig, or a calibration of another tool.

    The format is recognized by content: OpenCV, Kalibr, ROS, anipose, caliscope, FreeMoCap, Pose2Sim, COLMAP,
    multical, mrcal, EasyMocap, PyMVG, Qualisys, Motive and Vicon are known (docs/formats.md).

    Args:
        path: a file, a folder of files that are one calibration, or a name such as "O10" when there is no such file.
        unit: of another tool's file, where it does not say: "mm", "m", ..., or the length of one unit, "417.2mm".
        image_size: width and height of another tool's cameras, or by camera, where the file does not say.
        format: of another tool, by name; None = by what stands in the file.
        fit_limit: pixels that a lens may be off, anywhere in its image, where a fit of another model takes its place.

    Returns:
        The rig in float64 and millimetres, without batch axes.

    Raises:
        InputError: one line with the file, what was found and what was expected.
        RefusedError: no lens model of ours comes within `fit_limit`.

    Examples:
        >>> import imgcal
        >>> rig = imgcal.load_rig("O10")
        >>> rig.name, rig.num_cameras, rig.working_distance
        ('O10', 10, 850.14)
    """
    path = Path(path)
    stated = unit is not None or image_size is not None or format is not None
    if not stated and not (path.exists() and is_foreign(path)):
        return io.read_rig(path)
    if path.exists() and not is_foreign(path):
        raise InputError(f"{path}: an imgcal rig file states its own unit, image sizes and format: leave these out")
    return _convert_lenses(in_millimetres(read_foreign_rig(path, format), str(path), unit), path, image_size, fit_limit)


def load_cameras(
    path: str | Path,
    *,
    image_size: Size | Mapping[str, Size] | None = None,
    format: str | None = None,
    fit_limit: float = LIMIT,
) -> CameraRig:
    """Read cameras for a start without a factory calibration: their images and, roughly, their lenses.

    Args:
        path: a file of the format imgcal-cameras/1, or whatever `load_rig` takes, whose places and unit are not looked
            at. Cameras of anipose, caliscope, FreeMoCap, Pose2Sim and ROS need not have been placed.
        image_size: as in `load_rig`.
        format: as in `load_rig`.
        fit_limit: as in `load_rig`.

    Returns:
        Cameras that are all in the origin, and a prior that says that nothing is known of it.

    Raises:
        InputError: one line with the file, the camera, what was found and what was expected.
        RefusedError: no lens model of ours comes within `fit_limit`.

    Examples:
        >>> cameras = load_cameras("T4")
        >>> cameras.num_cameras, float(cameras.positions.abs().max())
        (4, 0.0)
    """
    path = Path(path)
    stated = image_size is not None or format is not None
    if not stated and not (path.exists() and is_foreign(path)):
        return io.load_cameras(path)
    return io.drop_poses(_convert_lenses(read_foreign_lenses(path, format), path, image_size, fit_limit))


def _convert_lenses(
    rig: ForeignRig, path: Path, image_size: Size | Mapping[str, Size] | None, fit_limit: float
) -> CameraRig:
    """Express a rig in our lens models, with its image sizes filled in."""
    sizes = image_size if isinstance(image_size, Mapping) else {} if image_size is None else {"": image_size}
    held = fit_to_target(fill_image_sizes(rig, str(path), sizes), NATIVE, "an imgcal rig", fit_limit)
    return to_camera_rig(held.rig, io.title_from_name(path if path.is_file() else path.resolve()))
