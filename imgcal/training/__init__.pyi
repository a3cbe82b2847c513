from .checkpoint import (
    Checkpoint,
    build_network,
    check_object,
    check_rig,
    load_checkpoint,
    load_network,
    read_subject,
    save_network,
)
from .engine import RESULT, STATE, finished, train
from .experiment import Experiment, load_experiment, save_experiment
from .log import read_metrics

__all__ = [
    "RESULT",
    "STATE",
    "Checkpoint",
    "Experiment",
    "build_network",
    "check_object",
    "check_rig",
    "finished",
    "load_checkpoint",
    "load_experiment",
    "load_network",
    "read_metrics",
    "read_subject",
    "save_experiment",
    "save_network",
    "train",
]
