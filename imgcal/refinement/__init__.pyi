from .graduated_non_convexity import SQUARED, RobustOptions, refine_robustly, robust_pose
from .points import as_prediction, observed, refine_points
from .render_and_compare import ImageRefinementOptions, refine_images

__all__ = [
    "SQUARED",
    "ImageRefinementOptions",
    "RobustOptions",
    "as_prediction",
    "observed",
    "refine_images",
    "refine_points",
    "refine_robustly",
    "robust_pose",
]
