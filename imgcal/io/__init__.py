"""Reading and writing files; every problem is an `InputError` of one line, and nothing is ever half-written."""

from imgcal.io.atomic import replacing, write_bytes, write_text
from imgcal.io.capture import Capture, open_capture, open_input, save_capture_settings
from imgcal.io.detections_csv import load_detections, save_detections
from imgcal.io.frames import Frame, read_frame, write_frame, write_image
from imgcal.io.object_csv import load_object, save_object
from imgcal.io.publishing import publishing
from imgcal.io.rig_yaml import RigCovariance, load_rig, load_rig_covariance, save_rig

__all__ = [
    "Capture",
    "Frame",
    "RigCovariance",
    "load_detections",
    "load_object",
    "load_rig",
    "load_rig_covariance",
    "open_capture",
    "open_input",
    "publishing",
    "read_frame",
    "replacing",
    "save_capture_settings",
    "save_detections",
    "save_object",
    "save_rig",
    "write_bytes",
    "write_frame",
    "write_image",
    "write_text",
]
