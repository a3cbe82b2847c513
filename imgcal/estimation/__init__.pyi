from . import lm_cpu
from .absorption import absorbed
from .accuracy import MAP_DEPTHS, MAP_SIZE, PredictedError, WorkingVolume, predicted_error
from .blocks import BlockScatter, block_scatter
from .brought import Brought
from .change_points import CLIP, LEAST_SNAPSHOTS
from .clock_slip import ClockSlip, image_of
from .correlation import correlation_time, effective_size
from .covariance import (
    camera_covariance,
    camera_std,
    flat_std,
    object_covariance,
    pose_covariance,
    relative_covariance,
    relative_difference,
    relative_jacobian,
    scale_response,
    whitened_covariance,
)
from .cusum import Cusum, cusum_threshold
from .gauge import aligned
from .held_rig import HeldRigFit, fit_pose
from .implicit import attach_gradient, map_cost
from .levenberg_marquardt import Solution
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
from .object_change import SHAPE, ObjectChange, changed_object
from .object_motion import ObjectMotion
from .object_shape import SNAPSHOTS_TO_BEND, FiducialOffset, ShapeEvidence, offsets
from .open_change import Change
from .pose_initialization import initial_pose
from .pose_support import ON_A_LINE, UndeterminedPosesError, require_poses
from .recent_snapshots import RecentSnapshots
from .rig_belief import Absorbed, RigBelief, aged, widened
from .rig_changes import CHANGES, ChangeTest, change_of_errors, pixel_changes, spread_of
from .rig_error import displaced, error_between, step_by_error
from .rig_filter import RigFilter
from .rig_initialization import K3, ColdStart, cold_start, ordinary_lens
from .rig_monitor import RigMonitor
from .rig_uncertainty import RigUncertainty, inverse_or_zero, pixel_jacobian, rigid_motion, uncertainty_over
from .robust_losses import squared
from .shaking import shared_shifts
from .steady_cameras import Gauge
from .variance_components import BENT, ObjectQuestion, Start, estimate_variance_components

__all__ = [
    "BENT",
    "CHANGES",
    "CLIP",
    "K3",
    "LEAST_SNAPSHOTS",
    "MAP_DEPTHS",
    "MAP_SIZE",
    "ON_A_LINE",
    "POSE_PARAMETERS",
    "SHAPE",
    "SNAPSHOTS_TO_BEND",
    "Absorbed",
    "BlockScatter",
    "Brought",
    "Change",
    "ChangeTest",
    "ClockSlip",
    "ColdStart",
    "Cusum",
    "Estimate",
    "EstimationOptions",
    "FiducialOffset",
    "Gauge",
    "HeldRigFit",
    "NormalEquations",
    "ObjectChange",
    "ObjectMotion",
    "ObjectQuestion",
    "PredictedError",
    "Problem",
    "RecentSnapshots",
    "RigBelief",
    "RigFilter",
    "RigMonitor",
    "RigUncertainty",
    "ShapeEvidence",
    "Solution",
    "Start",
    "State",
    "UndeterminedPosesError",
    "WorkingVolume",
    "absorbed",
    "aged",
    "aligned",
    "attach_gradient",
    "block_scatter",
    "camera_covariance",
    "camera_std",
    "change_of_errors",
    "changed_object",
    "cold_start",
    "correlation_time",
    "cusum_threshold",
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
    "image_of",
    "initial_pose",
    "initial_state",
    "inverse_or_zero",
    "linearize",
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
    "pixel_changes",
    "pixel_jacobian",
    "points_at",
    "pose_at",
    "pose_covariance",
    "predicted_error",
    "relative_covariance",
    "relative_difference",
    "relative_jacobian",
    "require_poses",
    "retract",
    "rig_at",
    "rigid_motion",
    "scale_response",
    "shared_shifts",
    "spread_of",
    "squared",
    "step_by_error",
    "uncertainty_over",
    "whitened_covariance",
    "widened",
    "with_lenses",
    "without_lenses",
]
