from .methods import BASELINES, Given, Method, network_method
from .metrics import Errors, cramer_rao, errors, reprojection_error
from .models import Model, load_models
from .protocol import Conditions, Evaluation, Progress, Protocol, Row, Scores, evaluate
from .report import PLOTS, RESULT, TABLES, Report, describe, markdown, tables, write
from .sweeps import AXES, Sweep, sweep
from .timing import latency

__all__ = [
    "AXES",
    "BASELINES",
    "PLOTS",
    "RESULT",
    "TABLES",
    "Conditions",
    "Errors",
    "Evaluation",
    "Given",
    "Method",
    "Model",
    "Progress",
    "Protocol",
    "Report",
    "Row",
    "Scores",
    "Sweep",
    "cramer_rao",
    "describe",
    "errors",
    "evaluate",
    "latency",
    "load_models",
    "markdown",
    "network_method",
    "reprojection_error",
    "sweep",
    "tables",
    "write",
]
