from .detectors import WRONG_PX, WRONG_RATIO, Contender, Outcome, Scene, compare_detectors, draw_capture, judge
from .encoder_check import LEAST_RISE, EncoderCheck, check_encoder
from .methods import BASELINES, QUICK_BASELINES, Given, Method, network_method, refine_by_positions
from .metrics import Errors, cramer_rao, errors, held_out_points, reprojection_error
from .models import Model, load_models
from .outcome_tables import detector_tables, detector_values
from .protocol import REFERENCE, Conditions, Evaluation, Progress, Protocol, Row, Scores, evaluate
from .sweeps import AXES, Sweep, sweep
from .tables import PLOTS, RESULT, TABLES, Facts, Summary, as_tables, describe, markdown, write
from .timing import Latency, latency

__all__ = [
    "AXES",
    "BASELINES",
    "LEAST_RISE",
    "PLOTS",
    "QUICK_BASELINES",
    "REFERENCE",
    "RESULT",
    "TABLES",
    "WRONG_PX",
    "WRONG_RATIO",
    "Conditions",
    "Contender",
    "EncoderCheck",
    "Errors",
    "Evaluation",
    "Facts",
    "Given",
    "Latency",
    "Method",
    "Model",
    "Outcome",
    "Progress",
    "Protocol",
    "Row",
    "Scene",
    "Scores",
    "Summary",
    "Sweep",
    "as_tables",
    "check_encoder",
    "compare_detectors",
    "cramer_rao",
    "describe",
    "detector_tables",
    "detector_values",
    "draw_capture",
    "errors",
    "evaluate",
    "held_out_points",
    "judge",
    "latency",
    "load_models",
    "markdown",
    "network_method",
    "refine_by_positions",
    "reprojection_error",
    "sweep",
    "write",
]
