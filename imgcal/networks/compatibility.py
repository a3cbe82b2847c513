"""Checks that a network was trained for the given rig and object, and for predicting rigs."""

from __future__ import annotations

from pathlib import Path

from imgcal.errors import InputError
from imgcal.networks.config import NetworkSpec
from imgcal.types import CalibrationObject, CameraRig, object_difference, rig_difference


def check_rig(path: str | Path, trained: CameraRig, rig: CameraRig) -> None:
    """Compare the factory values of two rigs.

    Raises:
        InputError: they differ; names the first camera and value that do.
    """
    difference = rig_difference(rig, trained)
    if difference is not None:
        raise InputError(f"{path}: trained for another rig than {rig.name} ({trained.name}): {difference}")


def is_position_training(experiment: NetworkSpec) -> bool:
    """Check whether a training was one of positions, which leaves the trunk untrained."""
    return getattr(experiment, "task", None) == "positions"


def check_says_rigs(path: str | Path, experiment: NetworkSpec) -> None:
    """Refuse a network that was trained only to find positions, not to predict rigs.

    Raises:
        InputError: the training's task was `positions`.
    """
    if is_position_training(experiment):
        raise InputError(
            f"{path}: found a training of positions, whose trunk is untrained; expected one of rigs, which starts "
            "from it by `training.init_from`"
        )


def check_object(path: str | Path, trained: CalibrationObject, obj: CalibrationObject) -> None:
    """Compare the fiducials of two objects, their radii included.

    Raises:
        InputError: they differ; names the first fiducial that does.
    """
    difference = object_difference(obj, trained)
    if difference is not None:
        raise InputError(f"{path}: trained for another object than {obj.name} ({trained.name}): {difference}")
