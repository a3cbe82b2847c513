from . import kernels, lens_kernels
from .lens_model import LensModel
from .lenses import (
    LENS_MODELS,
    ModelNames,
    distort_by_coefficients,
    distort_with_jacobian,
    lens_codes,
    lens_label,
    lens_names,
    lens_width,
    require_lenses,
    undistort,
)
from .object_turns import free_turns, pose_rank
from .projection import NEAREST_DEPTH, Projection, project_components, project_kornia, resized_pixels
from .projection_cpu import project_arrays, project_cpu, undistort_cpu
from .rotations import (
    cross_matrix,
    euler_from_rotation,
    geodesic_angle,
    left_jacobian,
    rotation_from_6d,
    rotation_from_euler,
    rotation_from_vector,
    sixd_from_rotation,
    vector_from_rotation,
)
from .shapes import require_shapes
from .transforms import Join, RigidTransform, rotate

__all__ = [
    "LENS_MODELS",
    "NEAREST_DEPTH",
    "Join",
    "LensModel",
    "ModelNames",
    "Projection",
    "RigidTransform",
    "cross_matrix",
    "distort_by_coefficients",
    "distort_with_jacobian",
    "euler_from_rotation",
    "free_turns",
    "geodesic_angle",
    "kernels",
    "left_jacobian",
    "lens_codes",
    "lens_kernels",
    "lens_label",
    "lens_names",
    "lens_width",
    "pose_rank",
    "project_arrays",
    "project_components",
    "project_cpu",
    "project_kornia",
    "require_lenses",
    "require_shapes",
    "resized_pixels",
    "rotate",
    "rotation_from_6d",
    "rotation_from_euler",
    "rotation_from_vector",
    "sixd_from_rotation",
    "undistort",
    "undistort_cpu",
    "vector_from_rotation",
]
