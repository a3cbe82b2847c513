"""Cameras at unknown positions: YAML, `format: imgcal-cameras/1`."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator

from imgcal.geometry import RigidTransform
from imgcal.io.atomic import write_text
from imgcal.io.names import title_from_name
from imgcal.io.rig_schema import FORMAT as RIG_FORMAT
from imgcal.io.rig_schema import CameraImages, Coefficient, Focal, Name, Pixel, check_names
from imgcal.io.rig_yaml import read_rig
from imgcal.io.validation import StrictModel, validate
from imgcal.io.yaml_file import Flow, read_yaml, yaml_text
from imgcal.types import CameraRig, RigPrior, limits

FORMAT = "imgcal-cameras/1"
FOCAL_SPREAD = 0.15
"""Relative: how far a focal length that is called rough may be off, one standard deviation."""
CENTRE_SPREAD = 0.02
"""Principal point, one standard deviation in parts of the longer side of the image."""
DISTORTION_SPREAD = 0.1
ANYWHERE = (1.0, 1e6)
"""Spread of unknown rotations, rad, and of unknown positions, mm."""

Degrees = Annotated[float, Field(gt=0, lt=180, allow_inf_nan=False)]


class _Camera(CameraImages):
    field_of_view: Degrees | None = None
    focal_length: Focal | Annotated[list[Focal], Field(min_length=2, max_length=2)] | None = None
    principal_point: Annotated[list[Pixel], Field(min_length=2, max_length=2)] | None = None
    distortion: Annotated[list[Coefficient], Field(min_length=5, max_length=5)] | None = None

    @model_validator(mode="after")
    def _check_values(self) -> _Camera:
        if (self.field_of_view is None) == (self.focal_length is None):
            raise ValueError("expected either `field_of_view` (degrees, across the longer side) or `focal_length` (px)")
        return self

    @property
    def focal(self) -> list[float]:
        if self.field_of_view is not None:
            return [max(self.image_size) / 2 / math.tan(math.radians(self.field_of_view) / 2)] * 2
        assert self.focal_length is not None
        return self.focal_length if isinstance(self.focal_length, list) else [self.focal_length] * 2


class _CamerasFile(StrictModel):
    format: Literal["imgcal-cameras/1"]
    name: Name | None = None
    focal_spread: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = FOCAL_SPREAD
    cameras: Annotated[list[_Camera], Field(min_length=1, max_length=limits.MOST_CAMERAS)]

    @model_validator(mode="after")
    def _check_consistency(self) -> _CamerasFile:
        check_names([camera.name for camera in self.cameras])
        return self


def load_cameras(path: str | Path) -> CameraRig:
    """Read cameras with known image sizes and rough focal lengths.

    Args:
        path: a YAML file of the format imgcal-cameras/1, or of a rig, whose places and prior are not looked at.

    Returns:
        Cameras that are all in the origin, and a prior that says that nothing is known of it.

    Raises:
        InputError: one line with the file, the camera, what was found and what was expected.

    Examples:
        >>> save_cameras({"left": (1280, 1024), "right": (1280, 1024)}, 65.0, "cameras.yaml")
        >>> cameras = load_cameras("cameras.yaml")
        >>> cameras.camera_names, cameras.focal_length[0].round()
        (('left', 'right'), tensor([1005., 1005.], dtype=torch.float64))
    """
    path = Path(path)
    if not path.is_file() or _names_format(path, RIG_FORMAT):
        return drop_poses(read_rig(path))
    content = read_yaml(path, _CamerasFile, FORMAT)
    cameras = content.cameras
    sizes = torch.tensor([camera.image_size for camera in cameras])
    middle = ((sizes - 1) / 2).tolist()
    centre = [camera.principal_point or there for camera, there in zip(cameras, middle, strict=True)]
    rig = CameraRig(
        focal_length=torch.tensor([camera.focal for camera in cameras], dtype=torch.float64),
        principal_point=torch.tensor(centre, dtype=torch.float64),
        distortion=torch.tensor([camera.distortion or [0.0] * 5 for camera in cameras], dtype=torch.float64),
        cam_from_rig=RigidTransform.identity(len(cameras), dtype=torch.float64),
        image_size=sizes,
        camera_names=tuple(camera.name for camera in cameras),
        name=content.name or title_from_name(path),
    )
    return drop_poses(rig, content.focal_spread)


def drop_poses(rig: CameraRig, focal_spread: float = FOCAL_SPREAD) -> CameraRig:
    """Forget the poses of a rig's cameras, and its uncertainty.

    Args:
        rig: without batch axes; its lenses are kept as a start.
        focal_spread: relative, one standard deviation of the focal lengths.

    Examples:
        >>> from imgcal.io import read_rig
        >>> cameras = drop_poses(read_rig("T4"))
        >>> float(cameras.positions.abs().max()), cameras.prior.focal_length
        (0.0, 0.15)
    """
    return replace(
        rig,
        cam_from_rig=RigidTransform.identity(rig.num_cameras, dtype=rig.focal_length.dtype),
        prior=RigPrior(focal_spread, CENTRE_SPREAD * float(rig.image_size.max()), DISTORTION_SPREAD, *ANYWHERE),
        working_distance=None,
        volume=None,
    )


def save_cameras(image_size: Mapping[str, tuple[int, int]], field_of_view_deg: float, path: str | Path) -> None:
    """Write a file for `load_cameras`.

    Args:
        image_size: pixels, width and height, by the camera's name.
        field_of_view_deg: of every camera, roughly: degrees across the longer side of the image.
        path: where to.

    Raises:
        InputError: a size or an angle that no camera has.
    """
    content: dict[str, Any] = {
        "format": FORMAT,
        "focal_spread": FOCAL_SPREAD,
        "cameras": [
            {"name": name, "image_size": Flow(size), "field_of_view": field_of_view_deg}
            for name, size in image_size.items()
        ],
    }
    validate(content, _CamerasFile, f"{path}: not written")
    write_text(path, yaml_text(content))


def _names_format(path: Path, file_format: str) -> bool:
    """Tell whether a file names a format; its reader checks the rest."""
    line = rf"(?m)^([\"']?)format\1[ \t]*:[ \t]*([\"']?){file_format}\2[ \t]*(#.*)?\r?$"
    with path.open("rb") as file:
        return re.search(line.encode(), file.read(4096)) is not None
