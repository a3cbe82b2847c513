from .atomic import replacing, write_bytes, write_text
from .cameras_yaml import drop_poses, load_cameras, save_cameras
from .capture import Capture, check_times, open_capture, open_input, save_capture_settings
from .detections_csv import DEFAULT_SIGMA, MARGIN, Fiducials, load_detections, save_detections
from .frames import IMAGE_SUFFIXES, VIDEO_SUFFIXES, Frame, Video, grey_frame, read_frame, write_frame, write_image
from .json_text import read_json
from .key_table import Key, list_keys
from .metrics import read_metrics
from .names import MODEL, find_file, is_file_name, model_file, model_name, natural_key, nearest, title_from_name
from .object_csv import load_object, load_objects, object_from_text, object_text, save_object
from .own_folder import holding
from .posterior_file import read_posterior, write_posterior
from .publication import PREVIOUS, keep_previous, publishing
from .resources import data_path, sample_path, shipped_names
from .rig_yaml import RigCovariance, load_rig, load_rig_covariance, rig_from_text, rig_text, save_rig
from .safetensors_file import read_tensors, read_texts, write_tensors
from .validation import StrictModel, StrictRecord, validate
from .yaml_file import (
    Flow,
    is_prose,
    looks_like,
    parse_foreign_yaml,
    parse_yaml,
    read_yaml,
    read_yaml_mapping,
    yaml_text,
)

__all__ = [
    "DEFAULT_SIGMA",
    "IMAGE_SUFFIXES",
    "MARGIN",
    "MODEL",
    "PREVIOUS",
    "VIDEO_SUFFIXES",
    "Capture",
    "Fiducials",
    "Flow",
    "Frame",
    "Key",
    "RigCovariance",
    "StrictModel",
    "StrictRecord",
    "Video",
    "check_times",
    "data_path",
    "drop_poses",
    "find_file",
    "grey_frame",
    "holding",
    "is_file_name",
    "is_prose",
    "keep_previous",
    "list_keys",
    "load_cameras",
    "load_detections",
    "load_object",
    "load_objects",
    "load_rig",
    "load_rig_covariance",
    "looks_like",
    "model_file",
    "model_name",
    "natural_key",
    "nearest",
    "object_from_text",
    "object_text",
    "open_capture",
    "open_input",
    "parse_foreign_yaml",
    "parse_yaml",
    "publishing",
    "read_frame",
    "read_json",
    "read_metrics",
    "read_posterior",
    "read_tensors",
    "read_texts",
    "read_yaml",
    "read_yaml_mapping",
    "replacing",
    "rig_from_text",
    "rig_text",
    "sample_path",
    "save_cameras",
    "save_capture_settings",
    "save_detections",
    "save_object",
    "save_rig",
    "shipped_names",
    "title_from_name",
    "validate",
    "write_bytes",
    "write_frame",
    "write_image",
    "write_posterior",
    "write_tensors",
    "write_text",
    "yaml_text",
]
