from .graduated_non_convexity import SQUARED, RobustOptions, refine_robustly, robust_pose
from .points import as_prediction, observed, refine_points
from .render_and_compare import ImageRefinementOptions, refine_images
from .render_and_compare_operator import encoded_image_options, refine_images_anywhere

__all__ = [
    "SQUARED",
    "ImageRefinementOptions",
    "RobustOptions",
    "as_prediction",
    "encoded_image_options",
    "observed",
    "refine_images",
    "refine_images_anywhere",
    "refine_points",
    "refine_robustly",
    "robust_pose",
]
