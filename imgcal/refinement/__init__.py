"""Refinement after the network: MAP on its points, or render-and-compare on its images."""

from imgcal.refinement.images import ImageRefinementOptions, refine_images
from imgcal.refinement.points import refine_points

__all__ = ["ImageRefinementOptions", "refine_images", "refine_points"]
