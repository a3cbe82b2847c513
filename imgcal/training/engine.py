"""The training loop: accelerate (one process or several, CPU or GPU), exact resume.

It only knows tasks. It writes no files and leaves torch's default generators alone; it reports through `Callbacks`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import broadcast
from torch import Tensor, nn

from imgcal.errors import InputError, RefusedError
from imgcal.networks import use_generators
from imgcal.training.callbacks import Callbacks, DivergedError
from imgcal.training.continuation import gather_state, restore
from imgcal.training.experiment import Experiment, TrainingConfig
from imgcal.training.optimization import (
    Schedule,
    freeze,
    make_average,
    make_optimizer,
    set_training_mode,
    update_average,
)
from imgcal.training.random_streams import make_stream
from imgcal.training.run import Best, Pending, Run
from imgcal.training.state import TrainingState

# Delay in steps before a GPU's numbers are read, because reading waits for the GPU. On a CPU there is no delay.
LAG = 50


def train(
    experiment: Experiment,
    callbacks: Callbacks | None = None,
    state: TrainingState | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Run:
    """Train the network of an experiment.

    Args:
        experiment: the network, its data and the length of the training.
        callbacks: receive the progress; None = no callbacks.
        state: continue from this state, as passed to `Callbacks.on_checkpoint`.
        should_stop: called after every step of the main process; True = make a checkpoint and return early.

    Returns:
        The run in its final state; `is_finished(run, run.seconds)` tells whether it is complete.

    Raises:
        InputError: unusable experiment, or a state that does not belong to it.
        DivergedError: the loss or its gradient is not finite.
        RefusedError: at the end, the validation error of the result or its weights are not finite.
    """
    run = prepare(experiment, state)
    listener = callbacks if callbacks is not None and run.accelerator.is_main_process else Callbacks()
    listener.on_start(run)
    try:
        _take_steps(run, listener, should_stop)
    finally:
        listener.on_end(run)
    return run


def _take_steps(run: Run, listener: Callbacks, should_stop: Callable[[], bool]) -> None:
    """Train until the end, or until a stop is requested."""
    due = run.experiment.training
    seconds, stop = run.seconds, False
    logged = (run.step, seconds)
    if is_finished(run, seconds):  # continued from its last state: its result may be missing
        validate(run, listener, extra=True)
        save(run, listener)
    while not (stop or is_finished(run, seconds)):
        run.schedule.set_progress(progress(run, seconds))
        train_step(run)
        seconds, stop = _agree(run, should_stop())
        listener.on_step(run, seconds)
        last = stop or is_finished(run, seconds)
        extra = run.step % due.log_every != 0
        if last or not extra:
            logged = _log(run, listener, logged, seconds, extra)
        extra = run.step % due.validate_every != 0
        if last or not extra:
            validate(run, listener, extra)
        last = last or is_finished(run, seconds)
        if last and not stop:
            _check_result(run)
        if last or run.step % due.save_every == 0:
            save(run, listener)


def prepare(experiment: Experiment, state: TrainingState | None = None) -> Run:
    """Build everything that a run needs, either new or from a state."""
    settings = experiment.training
    # Without a GPU, accelerate joins several processes only if `cpu` is set.
    accelerator = Accelerator(cpu=settings.device == "cpu" or not torch.accelerator.is_available())
    device, processes = accelerator.device, accelerator.num_processes
    batch_size = _micro_batch_size(settings, processes)
    weights = make_stream("weights", settings.seed)
    task = experiment.make_task(device, batch_size, weights, fresh=state is None)
    freeze(task.network, experiment.optimizer.freeze)
    set_training_mode(task.network)
    if settings.channels_last:
        task.network.to(memory_format=torch.channels_last)
    # One a kind of device: several processes train on "cpu:0", which has the same default generator as "cpu".
    stream = settings.seed, accelerator.process_index
    dropout = {own.type: make_stream("layers", *stream, own) for own in (torch.device("cpu"), device)}
    optimizer = make_optimizer(task.network, experiment.optimizer)
    average = None if experiment.optimizer.ema is None else make_average(task.network)
    judge = task.loss
    if settings.compile:
        mode = "reduce-overhead" if settings.compile == "graphs" else None
        task.network.compile(mode=mode)
        judge = torch.compile(task.loss, mode=mode)
    run = Run(
        experiment=experiment,
        accelerator=accelerator,
        task=task,
        network=accelerator.prepare(task.network),
        judge=judge,
        plain=task.network,
        optimizer=optimizer,
        schedule=Schedule(optimizer, experiment.schedule),
        average=average,
        generator=make_stream("data", *stream, device),
        dropout=tuple(dropout.values()),
        batch_size=batch_size,
    )
    if state is not None:
        restore(run, state)
    return run


def _micro_batch_size(settings: TrainingConfig, processes: int) -> int:
    """Number of samples that a process feeds to its network at once."""
    parts = processes * settings.accumulate
    if settings.batch_size % parts:
        of = f"the {processes} processes" + ("" if settings.accumulate == 1 else f" and {settings.accumulate} parts")
        raise InputError(f"training: batch_size: found {settings.batch_size}, expected a multiple of {of}")
    return settings.batch_size // parts


def train_step(run: Run) -> None:
    """Take one step; only making the batch waits for the device, and `check_finite` every `LAG` steps."""
    if len(run.pending) >= (1 if run.accelerator.device.type == "cpu" else LAG):
        check_finite(run)
    parts = run.experiment.training.accumulate
    run.optimizer.zero_grad(set_to_none=True)
    before, rows = [], []
    for part in range(parts):
        before.append(run.generator.get_state())
        with nullcontext() if part == parts - 1 else run.accelerator.no_sync(run.network):
            rows.append(_backward(run, parts))
    limit = run.experiment.optimizer.clip
    norm = torch.nn.utils.clip_grad_norm_(run.plain.parameters(), float("inf") if limit is None else limit)
    run.optimizer.step()
    run.step += 1
    if run.average is not None and run.experiment.optimizer.ema is not None:
        update_average(run.average, run.plain, run.step, run.experiment.optimizer.ema)
    run.pending.append(Pending(run.step, before, torch.stack((*(row["loss"] for row in rows), norm.detach()))))
    _account(run, rows)


def _backward(run: Run, parts: int) -> dict[str, Tensor]:
    """Add the gradient of one part of a batch; return its loss and other numbers by name, () each."""
    if run.experiment.training.compile == "graphs":
        torch.compiler.cudagraph_mark_step_begin()
    batch = run.task.batch(run.batch_size, run.generator)
    with use_generators(*run.dropout), autocast(run):
        answer = run.task.predict(run.network, batch)
    loss = run.judge(answer, batch, run.step)
    total = loss.total / parts
    if run.accelerator.num_processes > 1:
        # Processes exchange every gradient, so a parameter that nothing depends on needs one, too: zero.
        total = total + 0 * torch.stack([each.sum() for each in run.plain.parameters() if each.requires_grad]).sum()
    run.accelerator.backward(total)
    numbers = {"loss": loss.total.detach(), **loss.means}
    # Copy them: with CUDA graphs, the next step overwrites this memory.
    return dict(zip(numbers, torch.stack(list(numbers.values())).unbind(), strict=True))


def autocast(run: Run) -> torch.autocast:
    """Autocast as configured, for networks only; they exclude their geometry from it."""
    enabled = run.experiment.training.precision == "bf16"
    return torch.autocast(run.accelerator.device.type, torch.bfloat16, enabled=enabled)


def check_finite(run: Run) -> None:
    """Stop if the loss or the gradient of any step since the last check was not finite.

    Raises:
        DivergedError: with the batch, generated again; the last checkpoint is from before.
    """
    if not run.pending:
        return
    pending, run.pending = run.pending, []
    numbers = torch.stack([one.numbers for one in pending])
    finite = numbers.isfinite().all(-1).tolist()
    if all(finite):
        return
    first = finite.index(False)
    *losses, norm = numbers[first].tolist()
    part = next((part for part, loss in enumerate(losses) if not math.isfinite(loss)), len(losses) - 1)
    generator = torch.Generator(run.accelerator.device)
    generator.set_state(pending[first].generators[part])
    batch = run.task.batch(run.batch_size, generator)
    process = run.accelerator.process_index if run.accelerator.num_processes > 1 else None
    raise DivergedError(pending[first].step, losses[part], norm, batch, process)


@torch.no_grad()
def validation(run: Run, network: nn.Module) -> dict[str, float]:
    """Validate a network with its task, in evaluation mode."""

    def predict(batch: Any) -> Any:
        with autocast(run):
            return run.task.predict(network, batch)

    was_training = network.training
    network.eval()
    try:
        return run.task.validate(predict)
    finally:
        if was_training:
            set_training_mode(network)


def validate(run: Run, listener: Callbacks, extra: bool) -> None:
    """Report the errors of the current result weights; see `_record`."""
    check_finite(run)
    if run.accelerator.is_main_process and (found := validation(run, run.candidate)):
        _record(run, listener, {"step": run.step, **found}, extra)
    if run.experiment.training.patience is not None:
        _keep_best(run, extra)


def _keep_best(run: Run, extra: bool) -> None:
    """Remember the weights if they are the best so far. All processes must call this together; the main one decides.

    An `extra` validation only chooses the result, so that a resumed training equals an uninterrupted one.
    """
    judged, metrics = run.task.judged, run.own_metrics
    if run.accelerator.is_main_process and judged not in metrics and not extra:
        raise InputError(f"training: patience: found no {judged}; set validation_rigs to 1 or more")
    error = metrics.get(judged, math.inf)
    error = error if math.isfinite(error) else math.inf  # any finite number is better
    if run.accelerator.num_processes > 1:
        error = float(broadcast(torch.tensor(error, dtype=torch.float64, device=run.accelerator.device)))
    if extra:
        so_far = math.inf if run.best is None else run.best.error
        run.closing = Best(run.candidate, metrics, error) if error < so_far else None
    elif run.best is None:
        run.best = Best(make_average(run.candidate), metrics, error)
    elif error < run.best.error:
        run.best.network.load_state_dict(run.candidate.state_dict())
        run.best.metrics, run.best.error, run.best.since = metrics, error, 0
    else:
        run.best.since += 1


def _check_result(run: Run) -> None:
    """Refuse to end with an unusable network.

    Raises:
        RefusedError: the result's validation error or its weights are not finite.
    """
    network, metrics = run.chosen
    value = metrics.get(run.task.judged, 0.0)
    if not math.isfinite(value):
        raise RefusedError(
            f"step {run.step}: {run.task.judged} is {value:g}, expected a finite number: the training has diverged"
        )
    wrong = [name for name, tensor in network.state_dict().items() if not bool(tensor.isfinite().all())]
    if wrong:
        raise RefusedError(
            f"step {run.step}: found weights that are not finite ({wrong[0]}): the training has diverged"
        )


def save(run: Run, listener: Callbacks) -> None:
    """Pass on the state and the current result network; all processes must call this together."""
    check_finite(run)
    state = gather_state(run)
    if run.accelerator.is_main_process:
        listener.on_checkpoint(run, state, run.task.result(*run.chosen))


def progress(run: Run, seconds: float) -> float:
    """Finished share of the run, 0 to 1, by steps or by time, whichever is larger."""
    settings = run.experiment.training
    by_steps = 0.0 if settings.steps is None else run.step / settings.steps
    by_time = 0.0 if settings.minutes is None else seconds / (60 * settings.minutes)
    return min(max(by_steps, by_time), 1.0)


def is_finished(run: Run, seconds: float) -> bool:
    """Check whether the run has ended or stopped improving."""
    patience = run.experiment.training.patience
    exhausted = run.best is not None and patience is not None and run.best.since >= patience
    return exhausted or progress(run, seconds) >= 1


def _account(run: Run, rows: list[dict[str, Tensor]]) -> None:
    """Store the numbers for the log and the schedule: means over the parts of a batch."""
    row = rows[0] if len(rows) == 1 else {name: torch.stack([part[name] for part in rows]).mean() for name in rows[0]}
    total = row["loss"]
    run.window.append(row)
    if run.experiment.schedule.kind != "plateau":
        return
    added = torch.stack((total, torch.ones_like(total)))
    run.judged = added if run.judged is None else run.judged + added
    if run.step % run.experiment.schedule.every == 0:
        loss_sum, count = run.accelerator.reduce(run.judged, "mean").tolist()
        run.schedule.judge(loss_sum / count)
        run.judged = None


def _agree(run: Run, stop: bool) -> tuple[float, bool]:
    """Share the main process's clock and stop request with all processes."""
    if run.accelerator.num_processes == 1:
        return run.seconds, stop
    mine = torch.tensor([run.seconds, float(stop)], dtype=torch.float64, device=run.accelerator.device)
    seconds, stopping = broadcast(mine).tolist()
    return seconds, bool(stopping)


def _record(run: Run, listener: Callbacks, row: dict[str, Any], extra: bool) -> None:
    """Store plain values and pass them on. An `extra` row is only reported because the run ends here, for now."""
    run.latest |= row
    run.told = row if run.told.get("step") != run.step else run.told | row
    if not extra:
        run.metrics |= row
    listener.on_metrics(run, row, not extra)


def _log(run: Run, listener: Callbacks, logged: tuple[int, float], seconds: float, extra: bool) -> tuple[int, float]:
    """Report the means since the last report; return the start of the next interval."""
    names = tuple(run.window[0])
    means = torch.stack([torch.stack([row[name] for row in run.window]).mean() for name in names])
    if not extra:
        run.window.clear()
    numbers = run.accelerator.reduce(means, "mean").tolist()
    steps, duration = run.step - logged[0], seconds - logged[1]
    row: dict[str, Any] = {"step": run.step, **dict(zip(names, numbers, strict=True))}
    row["lr"] = max(group["lr"] for group in run.optimizer.param_groups)
    row[f"{run.task.unit}_per_s"] = steps * run.experiment.training.batch_size / max(duration, 1e-9)
    row["seconds"] = seconds
    _record(run, listener, row, extra)
    return run.step, seconds
