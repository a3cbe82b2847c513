from .graduated_non_convexity import SQUARED, RobustOptions, refine_robustly, robust_pose
from .points import make_observations, make_prediction, refine_points
from .render_and_compare import ImageRefinementOptions, refine_images
from .render_and_compare_operator import encode_image_options, refine_images_anywhere

__all__ = [
    "SQUARED",
    "ImageRefinementOptions",
    "RobustOptions",
    "encode_image_options",
    "make_observations",
    "make_prediction",
    "refine_images",
    "refine_images_anywhere",
    "refine_points",
    "refine_robustly",
    "robust_pose",
]
