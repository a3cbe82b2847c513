from .callbacks import Callbacks, DivergedError
from .engine import Run, finished, prepare, progress, train, train_step
from .experiment import Experiment, changed, experiment_of, load_experiment, save_experiment
from .state import TrainingState, load_state, save_state

__all__ = [
    "Callbacks",
    "DivergedError",
    "Experiment",
    "Run",
    "TrainingState",
    "changed",
    "experiment_of",
    "finished",
    "load_experiment",
    "load_state",
    "prepare",
    "progress",
    "save_experiment",
    "save_state",
    "train",
    "train_step",
]
