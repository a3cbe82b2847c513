from .matched_filter import MatchedFilter
from .photometry import Measured, measure_markers

__all__ = ["MatchedFilter", "Measured", "measure_markers"]
