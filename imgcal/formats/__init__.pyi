from .conversion import (
    StorableRig,
    describe_lens,
    fill_image_sizes,
    fit_to_target,
    from_camera_rig,
    in_millimetres,
    millimetres,
    to_camera_rig,
)
from .documents import Element, parse_xml
from .fitting import Fit, Holds
from .foreign_rig import ForeignCamera, ForeignRig, known_points, worst_difference
from .format import Files, Format
from .lens import Lens
from .limits import LIMIT
from .loading import load_cameras, load_rig
from .registry import FORMATS, find_format, is_foreign, read_foreign_rig
from .source import Source
from .write_back import Updated, write_into
from .writing import OURS, Written, convert_rig, select_cameras

__all__ = [
    "FORMATS",
    "LIMIT",
    "OURS",
    "Element",
    "Files",
    "Fit",
    "ForeignCamera",
    "ForeignRig",
    "Format",
    "Holds",
    "Lens",
    "Source",
    "StorableRig",
    "Updated",
    "Written",
    "convert_rig",
    "describe_lens",
    "fill_image_sizes",
    "find_format",
    "fit_to_target",
    "from_camera_rig",
    "in_millimetres",
    "is_foreign",
    "known_points",
    "load_cameras",
    "load_rig",
    "millimetres",
    "parse_xml",
    "read_foreign_rig",
    "select_cameras",
    "to_camera_rig",
    "worst_difference",
    "write_into",
]
