"""Training of the networks: experiment files, checkpoints, and the engine (`imgcal.training.engine.train`)."""

from imgcal.training.checkpoint import Checkpoint, build_network, load_checkpoint, load_network, save_network
from imgcal.training.experiment import Experiment, load_experiment, save_experiment

__all__ = [
    "Checkpoint",
    "Experiment",
    "build_network",
    "load_checkpoint",
    "load_experiment",
    "load_network",
    "save_experiment",
    "save_network",
]
