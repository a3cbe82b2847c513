from . import levenberg_marquardt_cpu
from .accuracy import MAP_DEPTHS, MAP_SIZE, PredictedError, WorkingVolume, predicted_error
from .change_points import CLIP, LEAST_SNAPSHOTS
from .correlation import autocorrelation, correlation_time
from .covariance import (
    camera_covariance,
    camera_std,
    joint_information,
    object_covariance,
    relative_covariance,
    relative_difference,
    relative_jacobian,
    scale_response,
    whitened_covariance,
)
from .delay_modes import delay_evidence
from .fixed_rig import FixedRigFit, fit_pose
from .gauge import align
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
from .linearization_cpu import linearize_rig, select_blocks
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
from .map_operator import encode_options, map_state, prepend_lenses, split_lenses
from .moves import MOUNT_JOINT, find_moves, longest_episode
from .object_shape import SNAPSHOTS_TO_BEND, FiducialOffset, ScaleEvidence, ShapeEvidence, offsets
from .pose_initialization import initial_pose
from .pose_support import UNPOSED, UndeterminedPosesError, has_poses, require_poses
from .reference_cameras import Gauge
from .remaining_variance import flat_std
from .rig_error import displace, error_between, error_by_step, step_by_error
from .rig_from_points import PointStart, cold_start_from_points, move_to_pair_frame, prior_of_pair
from .rig_initialization import K3, ColdStart, cold_start, ordinary_lens, robust_std, single_camera_poses
from .rig_uncertainty import RigUncertainty, inverse_or_zero, pixel_jacobian, rigid_motion, uncertainty_over
from .robust_losses import cauchy, squared
from .shape_modes import ModeEvidence, evidence_by_snapshot
from .snapshot_scatter import BlockScatter, block_scatter
from .variance_components import BENT, ObjectQuestion, Start, estimate_variance_components

__all__ = [
    "BENT",
    "CLIP",
    "K3",
    "LEAST_SNAPSHOTS",
    "MAP_DEPTHS",
    "MAP_SIZE",
    "MOUNT_JOINT",
    "POSE_PARAMETERS",
    "SNAPSHOTS_TO_BEND",
    "UNPOSED",
    "BlockScatter",
    "ColdStart",
    "Estimate",
    "EstimationOptions",
    "FiducialOffset",
    "FixedRigFit",
    "Gauge",
    "ModeEvidence",
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
    "align",
    "attach_gradient",
    "autocorrelation",
    "block_scatter",
    "camera_covariance",
    "camera_std",
    "cauchy",
    "cold_start",
    "cold_start_from_points",
    "correlation_time",
    "delay_evidence",
    "displace",
    "encode_options",
    "equations_at",
    "error_between",
    "error_by_step",
    "estimate",
    "estimate_variance_components",
    "evidence_by_snapshot",
    "find_moves",
    "fit_pose",
    "flat_std",
    "has_poses",
    "initial_pose",
    "initial_state",
    "inverse_or_zero",
    "joint_information",
    "levenberg_marquardt_cpu",
    "linearize",
    "linearize_lights",
    "linearize_rig",
    "longest_episode",
    "make_estimate",
    "make_loss",
    "make_problem",
    "map_cost",
    "map_state",
    "minimize",
    "move_to_pair_frame",
    "object_covariance",
    "object_prior_std",
    "offsets",
    "ordinary_lens",
    "pixel_jacobian",
    "points_at",
    "pose_at",
    "predicted_error",
    "prepend_lenses",
    "prior_of_pair",
    "relative_covariance",
    "relative_difference",
    "relative_jacobian",
    "require_poses",
    "retract",
    "rig_at",
    "rigid_motion",
    "robust_std",
    "scale_response",
    "select_blocks",
    "single_camera_poses",
    "split_lenses",
    "squared",
    "step_by_error",
    "uncertainty_over",
    "whitened_covariance",
]
