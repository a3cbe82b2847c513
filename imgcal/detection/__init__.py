"""Blobs in captured frames: OpenCV finds them, a fitted ellipse measures them."""

from imgcal.detection.centroids import Blobs
from imgcal.detection.detector import detect, detect_frame, detect_snapshot
from imgcal.detection.options import DetectionOptions
from imgcal.detection.populations import without_dim

__all__ = ["Blobs", "DetectionOptions", "detect", "detect_frame", "detect_snapshot", "without_dim"]
