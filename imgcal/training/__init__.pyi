from .callbacks import Callbacks, DivergedError
from .engine import Run, finished, prepare, progress, train, train_step
from .experiment import Experiment
from .experiment_file import KINDS, changed, load_experiment, save_experiment
from .infrared_task import InfraredExperiment, InfraredTask
from .measurer_task import MeasurerExperiment, MeasurerTask
from .rigs import RigExperiment, RigTask, experiment_of
from .state import TrainingState, load_state, save_state
from .task import Loss, Result, Task

__all__ = [
    "KINDS",
    "Callbacks",
    "DivergedError",
    "Experiment",
    "InfraredExperiment",
    "InfraredTask",
    "Loss",
    "MeasurerExperiment",
    "MeasurerTask",
    "Result",
    "RigExperiment",
    "RigTask",
    "Run",
    "Task",
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
