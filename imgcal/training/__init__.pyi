from .callbacks import Callbacks, DivergedError
from .engine import Run, is_finished, prepare, progress, train, train_step
from .experiment import Experiment
from .experiment_file import KINDS, change_experiment, load_experiment, save_experiment
from .frame_dataset import (
    CARD,
    HELD_OUT,
    HELD_OUT_PATCHES,
    TRAIN,
    TRAIN_PATCHES,
    FrameDataset,
    PatchDataset,
    adaptation,
    load_patches,
    load_splits,
)
from .infrared_task import InfraredExperiment, InfraredTask
from .labelled_crops import cut_labelled, find_shown, split
from .measurer_task import MeasurerExperiment, MeasurerTask
from .rigs import RigExperiment, RigTask, checkpoint_experiment
from .state import TrainingState, load_state, save_state
from .task import Loss, Result, Task

__all__ = [
    "CARD",
    "HELD_OUT",
    "HELD_OUT_PATCHES",
    "KINDS",
    "TRAIN",
    "TRAIN_PATCHES",
    "Callbacks",
    "DivergedError",
    "Experiment",
    "FrameDataset",
    "InfraredExperiment",
    "InfraredTask",
    "Loss",
    "MeasurerExperiment",
    "MeasurerTask",
    "PatchDataset",
    "Result",
    "RigExperiment",
    "RigTask",
    "Run",
    "Task",
    "TrainingState",
    "adaptation",
    "change_experiment",
    "checkpoint_experiment",
    "cut_labelled",
    "find_shown",
    "is_finished",
    "load_experiment",
    "load_patches",
    "load_splits",
    "load_state",
    "prepare",
    "progress",
    "save_experiment",
    "save_state",
    "split",
    "train",
    "train_step",
]
