"""The training loop: accelerate (one process or several, CPU or GPU), exact resume.

It writes nothing and leaves torch's default generators alone: what it has to tell goes to `Callbacks`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from time import monotonic
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import broadcast
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.networks import Checkpoint, build_network, drawing_from, warm_start, without_pretrained
from imgcal.nn import project_fiducials, reprojection_re
from imgcal.synthesis import Snapshots
from imgcal.training.callbacks import Callbacks, DivergedError
from imgcal.training.data import Batch, Source, object_to
from imgcal.training.end_to_end import refined_loss
from imgcal.training.experiment import Experiment
from imgcal.training.losses import LossTerms, compound
from imgcal.training.optimization import (
    Schedule,
    make_average,
    make_optimizer,
    optimizer_settings,
    optimizer_tensors,
    restore_optimizer,
    update_average,
)
from imgcal.training.run import Run
from imgcal.training.state import TrainingState, random_states, restore_random_states
from imgcal.types import CalibrationObject

WINDOW = ("losses", "passes")  # names of `Run.window`'s columns in the state

# Seeds of what must not depend on how long the training takes: validation rigs.
VALIDATION_SEED = 20_000_003


def train(
    experiment: Experiment,
    callbacks: Callbacks | None = None,
    state: TrainingState | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Run:
    """Train the network of an experiment.

    Args:
        experiment: what to train, on what, for how long.
        callbacks: told how it goes; None = nobody is.
        state: go on from this one, which `Callbacks.on_checkpoint` was given.
        should_stop: asked after every step of the main process; True = make a checkpoint and return early.

    Returns:
        The run as it ended; `finished(run, run.seconds)` tells whether it came to its end.

    Raises:
        InputError: unusable experiment, or a state that does not belong to it.
        DivergedError: the loss or its gradient is not finite.
    """
    run = prepare(experiment, state)
    told = callbacks if callbacks is not None and run.accelerator.is_main_process else Callbacks()
    told.on_start(run)
    try:
        _take_steps(run, told, should_stop)
    finally:
        told.on_end(run)
    return run


def _take_steps(run: Run, told: Callbacks, should_stop: Callable[[], bool]) -> None:
    """Train until the end, or until somebody wants to stop."""
    due = run.experiment.training
    seconds, stop = run.seconds, False
    logged = (run.step, seconds)
    while not (stop or finished(run, seconds)):
        run.schedule.set_progress(progress(run, seconds))
        train_step(run)
        seconds, stop = _agreed(run, should_stop())
        last = stop or finished(run, seconds)
        extra = run.step % due.log_every != 0
        if last or not extra:
            logged = _log(run, told, logged, seconds, extra)
        extra = run.step % due.validate_every != 0
        if run.validation and (last or not extra):
            validate(run, told, extra)
        if last or run.step % due.save_every == 0:
            save(run, told)


def prepare(experiment: Experiment, state: TrainingState | None = None) -> Run:
    """Build everything a run needs: untrained, or as it was when a state was made."""
    settings = experiment.training
    # Without a GPU, accelerate joins several processes only where it is told to stay on the CPU.
    accelerator = Accelerator(cpu=settings.device == "cpu" or not torch.accelerator.is_available())
    device, processes = accelerator.device, accelerator.num_processes
    if settings.batch_size % processes:
        raise InputError(
            f"training: batch_size: found {settings.batch_size}, expected a multiple of the {processes} processes"
        )
    factory, obj = experiment.load_rig(), experiment.load_object()
    weights = torch.Generator().manual_seed(settings.seed)
    network = build_network(experiment if state is None else without_pretrained(experiment), factory, obj, weights)
    untrained = () if state is not None or settings.init_from is None else warm_start(settings.init_from, network)
    plain = network.to(device)
    source = Source(
        factory.to(torch.float32, device),
        object_to(obj, device),
        experiment.drift,
        experiment.poses,
        experiment.corruption,
        network.image_options,
    )
    seed = settings.seed * 4096 + accelerator.process_index
    optimizer = make_optimizer(plain, experiment.optimizer)
    average = None if experiment.optimizer.ema is None else make_average(plain)
    run = Run(
        experiment=experiment,
        accelerator=accelerator,
        factory=factory,
        obj=obj,
        network=accelerator.prepare(plain),
        plain=plain,
        optimizer=optimizer,
        schedule=Schedule(optimizer, experiment.schedule),
        average=average,
        source=source,
        prior_std=source.drift.std(factory).to(device, torch.float32),
        generator=torch.Generator(device).manual_seed(seed),
        dropout=tuple(torch.Generator(kind).manual_seed(seed) for kind in {"cpu": 0, str(device): 0}),
        validation=_validation_rigs(source, settings.validation_rigs, settings.batch_size // processes, device),
        batch_size=settings.batch_size // processes,
        untrained=untrained,
    )
    if state is not None:
        restore(run, state)
    return run


def train_step(run: Run) -> None:
    """Take one step; nothing here waits for the device but the synthesis of the batch."""
    made = run.source.sample(run.batch_size, run.generator)
    check_finite(run)  # the step before this one: its numbers are there by now
    batch = run.source.show(made, run.generator)
    run.optimizer.zero_grad(set_to_none=True)
    with drawing_from(*run.dropout), autocast(run.experiment, run.accelerator.device):
        predictions = run.network(batch.views)
    config, weights = run.experiment.loss, run.plain.parameters()
    loss = compound(predictions, batch.truth, run.source.obj, config, run.step, run.prior_std, weights)
    refined = refined_loss(predictions[-1], batch, run.source, run.prior_std, config.refined)
    loss = replace(loss, total=loss.total + refined)
    run.accelerator.backward(loss.total)
    limit = run.experiment.optimizer.clip
    norm = torch.nn.utils.clip_grad_norm_(run.plain.parameters(), float("inf") if limit is None else limit)
    run.optimizer.step()
    run.step += 1
    if run.average is not None and run.experiment.optimizer.ema is not None:
        update_average(run.average, run.plain, run.step, run.experiment.optimizer.ema)
    _account(run, batch, loss, norm)


def autocast(experiment: Experiment, device: torch.device) -> torch.autocast:
    """Autocast as the experiment says, for networks only; they keep their geometry out of it."""
    return torch.autocast(device.type, torch.bfloat16, enabled=experiment.training.precision == "bf16")


def check_finite(run: Run) -> None:
    """Stop when the last step's loss or gradient was not finite.

    Raises:
        DivergedError: with the batch; the last checkpoint is from before.
    """
    if run.pending is None:
        return
    batch, numbers = run.pending
    run.pending = None
    loss, norm = numbers.tolist()
    if torch.tensor([loss, norm]).isfinite().all():
        return
    several = run.accelerator.num_processes > 1
    raise DivergedError(run.step, loss, norm, batch, run.accelerator.process_index if several else None)


@torch.no_grad()
def validation_errors(
    network: nn.Module, batches: Iterable[Batch], obj: CalibrationObject, experiment: Experiment
) -> Tensor:
    """RE of each rig of some batches, in pixels: (R,). Batches may be made one after the other."""
    was_training = network.training
    network.eval()
    errors = []
    for batch in batches:
        with autocast(experiment, obj.points.device):
            predicted = network(batch.views)[-1]
        difference = project_fiducials(predicted.cameras_from_object, obj) - project_fiducials(
            batch.truth.cameras_from_object, obj
        )
        errors.append(reprojection_re(difference))
    network.train(was_training)
    return torch.cat(errors)


def validate(run: Run, told: Callbacks, extra: bool) -> None:
    """Tell the error of the weights as they would be the result, on rigs that are always the same; see `_tell`."""
    check_finite(run)
    if not run.accelerator.is_main_process:
        return
    generator = torch.Generator(run.accelerator.device).manual_seed(VALIDATION_SEED)
    batches = (run.source.show(made, generator) for made in run.validation)
    errors = validation_errors(run.best_weights, batches, run.source.obj, run.experiment)
    mean, median = float(errors.mean()), float(errors.median())
    _tell(run, told, {"step": run.step, "validation_re_px": mean, "validation_re_median_px": median}, extra)


def save(run: Run, told: Callbacks) -> None:
    """Give away the state, and the network as it would be the result now; all processes must call this together."""
    check_finite(run)
    gathered = {
        name: run.accelerator.gather(state.to(run.accelerator.device)[None])
        for name, state in random_states(run.generator, run.dropout).items()
    }
    judged = None if run.judged is None else run.judged.tolist()
    values = {
        "step": run.step,
        "elapsed": run.seconds,
        "processes": run.accelerator.num_processes,
        "optimizer": optimizer_settings(run.optimizer),
        "schedule": run.schedule.state(),
        "judged": judged,
        "metrics": run.metrics,
    }
    tensors = {
        "network": run.plain.state_dict(),
        "average": {} if run.average is None else run.average.state_dict(),
        "optimizer": optimizer_tensors(run.optimizer),
        "random": gathered,
        "window": {
            name: run.accelerator.gather(torch.stack(column)[None])
            for name, column in zip(WINDOW, zip(*run.window, strict=True), strict=False)
        },
    }
    if run.accelerator.is_main_process:
        metrics = {name: value for name, value in run.latest.items() if name != "lr"} | {"seconds": run.seconds}
        checkpoint = Checkpoint(run.best_weights, run.factory, run.obj, run.experiment, metrics)
        told.on_checkpoint(run, TrainingState(tensors, values, run.experiment), checkpoint)


def restore(run: Run, state: TrainingState) -> None:
    """Go on where a state was made.

    Raises:
        InputError: it is that of another number of processes.
    """
    values, tensors, index = state.values, state.tensors, run.accelerator.process_index
    if values["processes"] != run.accelerator.num_processes:
        expected = values["processes"]
        raise InputError(f"training: found {run.accelerator.num_processes} processes, expected {expected} as before")
    run.plain.load_state_dict(tensors["network"])
    if run.average is not None:
        run.average.load_state_dict(tensors["average"])
    restore_optimizer(run.optimizer, tensors["optimizer"], values["optimizer"])
    run.schedule.restore(values["schedule"])
    states = {name: rows[index] for name, rows in tensors["random"].items()}
    restore_random_states(run.generator, run.dropout, states)
    run.step, run.elapsed, run.began = values["step"], values["elapsed"], monotonic()
    run.metrics = dict(values.get("metrics", {}))
    run.latest = dict(run.metrics)
    if "window" in tensors:
        columns = (tensors["window"][name][index].to(run.accelerator.device).unbind() for name in WINDOW)
        run.window = list(zip(*columns, strict=True))
    if values["judged"] is not None:
        run.judged = torch.tensor(values["judged"], device=run.accelerator.device)


def progress(run: Run, seconds: float) -> float:
    """How much of the run is done, 0 to 1, by steps or by time, whichever is further."""
    settings = run.experiment.training
    by_steps = 0.0 if settings.steps is None else run.step / settings.steps
    by_time = 0.0 if settings.minutes is None else seconds / (60 * settings.minutes)
    return min(max(by_steps, by_time), 1.0)


def finished(run: Run, seconds: float) -> bool:
    """Tell whether the run came to its end."""
    return progress(run, seconds) >= 1


def _account(run: Run, batch: Batch, loss: LossTerms, norm: Tensor) -> None:
    """Keep what the log, the schedule and the check for finite numbers will want to know."""
    total = loss.total.detach()
    run.pending = (batch, torch.stack((total, norm.detach())))
    run.window.append((total, loss.passes))
    if run.experiment.schedule.kind != "plateau":
        return
    added = torch.stack((total, torch.ones_like(total)))
    run.judged = added if run.judged is None else run.judged + added
    if run.step % run.experiment.schedule.every == 0:
        loss_sum, count = run.accelerator.reduce(run.judged, "mean").tolist()
        run.schedule.judge(loss_sum / count)
        run.judged = None


def _agreed(run: Run, stop: bool) -> tuple[float, bool]:
    """The main process's clock and wish to stop, so that all processes do the same."""
    if run.accelerator.num_processes == 1:
        return run.seconds, stop
    mine = torch.tensor([run.seconds, float(stop)], dtype=torch.float64, device=run.accelerator.device)
    seconds, stopping = broadcast(mine).tolist()
    return seconds, bool(stopping)


def _tell(run: Run, told: Callbacks, row: dict[str, Any], extra: bool) -> None:
    """Keep plain values and pass them on. An `extra` row is not due: the run ends here, for now."""
    run.latest |= row
    if not extra:
        run.metrics |= row
    told.on_metrics(run, row, not extra)


def _log(run: Run, told: Callbacks, logged: tuple[int, float], seconds: float, extra: bool) -> tuple[int, float]:
    """Tell the means since the last time; returns where the next means begin."""
    totals, passes = (torch.stack(column) for column in zip(*run.window, strict=True))
    if not extra:
        run.window.clear()
    numbers = run.accelerator.reduce(torch.cat((totals.mean()[None], passes.mean(0))), "mean").tolist()
    steps, duration = run.step - logged[0], seconds - logged[1]
    row: dict[str, Any] = {"step": run.step, "loss": numbers[0], "re_px": numbers[-1]}
    row |= {f"re_pass{t + 1}_px": re for t, re in enumerate(numbers[1:-1])}
    row["lr"] = max(group["lr"] for group in run.optimizer.param_groups)
    row["rigs_per_s"] = steps * run.experiment.training.batch_size / max(duration, 1e-9)
    row["seconds"] = seconds
    _tell(run, told, row, extra)
    return run.step, seconds


def _validation_rigs(source: Source, rigs: int, batch_size: int, device: torch.device) -> list[Snapshots]:
    generator = torch.Generator(device).manual_seed(VALIDATION_SEED)
    return [source.sample(min(batch_size, rigs - start), generator) for start in range(0, rigs, batch_size)]
