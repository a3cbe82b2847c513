"""How good calibrations are: metrics, baselines, the paper's protocol, reports."""

from imgcal.evaluation.methods import BASELINES, Given, Method, network_method
from imgcal.evaluation.metrics import Errors, cramer_rao, errors, reprojection_error
from imgcal.evaluation.protocol import Conditions, Evaluation, Protocol, Row, Scores, evaluate
from imgcal.evaluation.sweep import AXES, Sweep, sweep
from imgcal.synthesis.corruption import Corrupted, Corruption

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
    "Row",
    "Scores",
    "Sweep",
    "cramer_rao",
    "errors",
    "evaluate",
    "network_method",
    "reprojection_error",
    "sweep",
]
