from . import kernels
from .projection import (
    NEAREST_DEPTH,
    Projection,
    distort_with_jacobian,
    project_components,
    project_kornia,
    resized_pixels,
    undistort,
)
from .projection_cpu import project_cpu, undistort_cpu
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
from .transforms import Join, RigidTransform, rotate

__all__ = [
    "NEAREST_DEPTH",
    "Join",
    "Projection",
    "RigidTransform",
    "cross_matrix",
    "distort_with_jacobian",
    "euler_from_rotation",
    "geodesic_angle",
    "kernels",
    "left_jacobian",
    "project_components",
    "project_cpu",
    "project_kornia",
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
