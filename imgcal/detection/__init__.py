"""Blobs in captured frames: OpenCV finds them, a fitted ellipse measures them."""

from imgcal.detection.detector import detect, detect_frame, detect_snapshot
from imgcal.detection.measuring import Blobs
from imgcal.detection.options import DetectionOptions

__all__ = ["Blobs", "DetectionOptions", "detect", "detect_frame", "detect_snapshot"]
