from .conversion import Held, describe_lens, from_camera_rig, held_by, to_camera_rig, with_image_sizes
from .documents import Element, parse_xml
from .fitting import Fit, Holds
from .foreign_rig import ForeignCamera, ForeignRig
from .format import Files, Format
from .lens import Lens
from .limits import LIMIT
from .loading import load_cameras, load_rig
from .registry import FORMATS, format_named, is_foreign, read_foreign_rig
from .units import in_millimetres, millimetres
from .verification import known_points, worst_difference
from .write_back import Updated, written_back
from .writing import OURS, Written, converted, selected

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
    "Held",
    "Holds",
    "Lens",
    "Updated",
    "Written",
    "converted",
    "describe_lens",
    "format_named",
    "from_camera_rig",
    "held_by",
    "in_millimetres",
    "is_foreign",
    "known_points",
    "load_cameras",
    "load_rig",
    "millimetres",
    "parse_xml",
    "read_foreign_rig",
    "selected",
    "to_camera_rig",
    "with_image_sizes",
    "worst_difference",
    "written_back",
]
