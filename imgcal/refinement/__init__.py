"""Refinement after the network: MAP on its points, with outliers or without, or render-and-compare on its images."""

from imgcal.refinement.graduated_non_convexity import RobustOptions, refine_robustly
from imgcal.refinement.points import as_prediction, refine_points
from imgcal.refinement.render_and_compare import ImageRefinementOptions, refine_images

__all__ = [
    "ImageRefinementOptions",
    "RobustOptions",
    "as_prediction",
    "refine_images",
    "refine_points",
    "refine_robustly",
]
