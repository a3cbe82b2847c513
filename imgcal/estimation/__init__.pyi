from . import lm_cpu
from .accuracy import MAP_DEPTHS, MAP_SIZE, PredictedError, WorkingVolume, predicted_error
from .blocks import BlockScatter, block_scatter
from .change_points import CLIP, LEAST_SNAPSHOTS
from .correlation import autocorrelation, correlation_time, effective_size
from .covariance import (
    camera_covariance,
    camera_std,
    flat_std,
    joint_information,
    object_covariance,
    pose_covariance,
    relative_covariance,
    relative_difference,
    relative_jacobian,
    scale_response,
    whitened_covariance,
)
from .gauge import aligned
from .held_rig import HeldRigFit, fit_pose
from .implicit import attach_gradient, map_cost
from .levenberg_marquardt import Solution
from .light_linearization_cpu import linearize_lights
from .linearization import (
    POSE_PARAMETERS,
    NormalEquations,
    Problem,
    State,
    linearize,
    points_at,
    pose_at,
    retract,
    rig_at,
)
from .linearization_cpu import blocks_of, linearize_rig
from .map_estimate import (
    Estimate,
    EstimationOptions,
    equations_at,
    estimate,
    initial_state,
    make_estimate,
    make_loss,
    make_problem,
    minimize,
    object_prior_std,
)
from .map_operator import encoded, map_state, with_lenses, without_lenses
from .moves import find_moves
from .object_shape import SNAPSHOTS_TO_BEND, FiducialOffset, ScaleEvidence, ShapeEvidence, offsets
from .pose_initialization import initial_pose
from .pose_support import ON_A_LINE, UndeterminedPosesError, has_poses, require_poses
from .rig_error import displaced, error_between, step_by_error
from .rig_from_points import PointStart, cold_start_from_points, in_frame_of_pair, prior_of_pair
from .rig_initialization import K3, ColdStart, cold_start, ordinary_lens, poses_alone
from .rig_uncertainty import RigUncertainty, inverse_or_zero, pixel_jacobian, rigid_motion, uncertainty_over
from .robust_losses import squared
from .steady_cameras import Gauge
from .variance_components import BENT, ObjectQuestion, Start, estimate_variance_components

__all__ = [
    "BENT",
    "CLIP",
    "K3",
    "LEAST_SNAPSHOTS",
    "MAP_DEPTHS",
    "MAP_SIZE",
    "ON_A_LINE",
    "POSE_PARAMETERS",
    "SNAPSHOTS_TO_BEND",
    "BlockScatter",
    "ColdStart",
    "Estimate",
    "EstimationOptions",
    "FiducialOffset",
    "Gauge",
    "HeldRigFit",
    "NormalEquations",
    "ObjectQuestion",
    "PointStart",
    "PredictedError",
    "Problem",
    "RigUncertainty",
    "ScaleEvidence",
    "ShapeEvidence",
    "Solution",
    "Start",
    "State",
    "UndeterminedPosesError",
    "WorkingVolume",
    "aligned",
    "attach_gradient",
    "autocorrelation",
    "block_scatter",
    "blocks_of",
    "camera_covariance",
    "camera_std",
    "cold_start",
    "cold_start_from_points",
    "correlation_time",
    "displaced",
    "effective_size",
    "encoded",
    "equations_at",
    "error_between",
    "estimate",
    "estimate_variance_components",
    "find_moves",
    "fit_pose",
    "flat_std",
    "has_poses",
    "in_frame_of_pair",
    "initial_pose",
    "initial_state",
    "inverse_or_zero",
    "joint_information",
    "linearize",
    "linearize_lights",
    "linearize_rig",
    "lm_cpu",
    "make_estimate",
    "make_loss",
    "make_problem",
    "map_cost",
    "map_state",
    "minimize",
    "object_covariance",
    "object_prior_std",
    "offsets",
    "ordinary_lens",
    "pixel_jacobian",
    "points_at",
    "pose_at",
    "pose_covariance",
    "poses_alone",
    "predicted_error",
    "prior_of_pair",
    "relative_covariance",
    "relative_difference",
    "relative_jacobian",
    "require_poses",
    "retract",
    "rig_at",
    "rigid_motion",
    "scale_response",
    "squared",
    "step_by_error",
    "uncertainty_over",
    "whitened_covariance",
    "with_lenses",
    "without_lenses",
]
