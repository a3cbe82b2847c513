"""How good calibrations are: corruption of views, metrics, baselines, the paper's protocol, reports."""

from imgcal.evaluation.corruption import Corrupted, Corruption
from imgcal.evaluation.methods import BASELINES, Given, Method, network_method
from imgcal.evaluation.metrics import Errors, cramer_rao, errors, reprojection_error
from imgcal.evaluation.protocol import Conditions, Evaluation, Protocol, Row, Scores, evaluate
from imgcal.evaluation.refine import RefinementOptions, refine_robustly
from imgcal.evaluation.sweep import AXES, Sweep, sweep

__all__ = [
    "AXES",
    "BASELINES",
    "Conditions",
    "Corrupted",
    "Corruption",
    "Errors",
    "Evaluation",
    "Given",
    "Method",
    "Protocol",
    "RefinementOptions",
    "Row",
    "Scores",
    "Sweep",
    "cramer_rao",
    "errors",
    "evaluate",
    "network_method",
    "refine_robustly",
    "reprojection_error",
    "sweep",
]
