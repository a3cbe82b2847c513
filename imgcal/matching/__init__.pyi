from .camera_threads import each_camera
from .matched_filter import MatchedFilter
from .photometry import Measured, measure_markers

__all__ = ["MatchedFilter", "Measured", "each_camera", "measure_markers"]
