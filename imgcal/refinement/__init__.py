"""Refinement after the network: MAP on its points, with outliers or without, or render-and-compare on its images."""

from imgcal.refinement.images import ImageRefinementOptions, refine_images
from imgcal.refinement.points import as_prediction, refine_points
from imgcal.refinement.robust import RobustOptions, refine_robustly

__all__ = [
    "ImageRefinementOptions",
    "RobustOptions",
    "as_prediction",
    "refine_images",
    "refine_points",
    "refine_robustly",
]
