"""The state of a run: gathered from one run, and restored into another."""

from __future__ import annotations

from time import monotonic

import torch

from imgcal.errors import InputError
from imgcal.training.optimization import make_average, optimizer_settings, optimizer_tensors, restore_optimizer
from imgcal.training.run import Best, Run
from imgcal.training.state import TrainingState, random_states, restore_random_states


def gather_state(run: Run) -> TrainingState:
    """Gather the state; all processes must call this together, and only the main one's result is complete."""
    gathered = {
        name: run.accelerator.gather(state.to(run.accelerator.device)[None])
        for name, state in random_states(run.generator, run.dropout).items()
    }
    values = {
        "step": run.step,
        "elapsed": run.seconds,
        "processes": run.accelerator.num_processes,
        "files": dict(run.task.files),
        "optimizer": optimizer_settings(run.optimizer),
        "schedule": run.schedule.state(),
        "judged": None if run.judged is None else run.judged.tolist(),
        "metrics": run.metrics,
        "best": run.best and {"metrics": run.best.metrics, "error": run.best.error, "since": run.best.since},
    }
    names = tuple(run.window[0]) if run.window else ()
    tensors = {
        "network": run.plain.state_dict(),
        "average": {} if run.average is None else run.average.state_dict(),
        "best": {} if run.best is None else run.best.network.state_dict(),
        "optimizer": optimizer_tensors(run.optimizer),
        "random": gathered,
        "window": {
            name: run.accelerator.gather(torch.stack([row[name] for row in run.window])[None]) for name in names
        },
    }
    return TrainingState(tensors, values, run.experiment)


def restore(run: Run, state: TrainingState) -> None:
    """Continue a run from a state.

    Raises:
        InputError: the state has another number of processes, or a rig or object file with other content.
    """
    values, tensors, index = state.values, state.tensors, run.accelerator.process_index
    if values["processes"] != run.accelerator.num_processes:
        expected = values["processes"]
        raise InputError(f"training: found {run.accelerator.num_processes} processes, expected {expected} as before")
    for key, text in run.task.files.items():
        if values.get("files", {}).get(key, text) != text:
            raise InputError(f"{key}: its file has changed since the training began; --resume needs the same file")
    run.plain.load_state_dict(tensors["network"])
    if run.average is not None:
        run.average.load_state_dict(tensors["average"])
    if values.get("best") is not None and run.experiment.training.patience is not None:
        run.best = Best(make_average(run.plain), **values["best"])
        run.best.network.load_state_dict(tensors["best"])
    restore_optimizer(run.optimizer, tensors["optimizer"], values["optimizer"])
    run.schedule.restore(values["schedule"])
    # A generator reads the memory of its state from the start: a row of a matrix must be copied.
    states = {name: rows[index].clone() for name, rows in tensors["random"].items()}
    restore_random_states(run.generator, run.dropout, states)
    run.step, run.elapsed, run.began = values["step"], values["elapsed"], monotonic()
    run.metrics = dict(values.get("metrics", {}))
    run.latest = dict(run.metrics)
    window = {name: rows[index].to(run.accelerator.device) for name, rows in tensors.get("window", {}).items()}
    if "loss" in window:  # states of older versions have other columns
        run.window = [dict(zip(window, row, strict=True)) for row in zip(*window.values(), strict=True)]
    if values["judged"] is not None:
        run.judged = torch.tensor(values["judged"], device=run.accelerator.device)
