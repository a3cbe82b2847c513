"""The training loop: accelerate (one process or several, CPU or GPU), exact resume, a log, one result."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import monotonic
from typing import Any, cast

import torch
from accelerate import Accelerator
from accelerate.utils import broadcast
from torch import Tensor, nn

from imgcal.errors import InputError, RefusedError
from imgcal.io import write_tensors
from imgcal.synthesis import ImageOptions, Snapshots
from imgcal.training.checkpoint import build_network, save_network, warm_start, without_pretrained
from imgcal.training.data import Batch, Source, object_to
from imgcal.training.end_to_end import refined_loss
from imgcal.training.experiment import Experiment, save_experiment
from imgcal.training.log import Log
from imgcal.training.losses import LossTerms, compound, project_fiducials, reprojection_re
from imgcal.training.optimization import (
    Schedule,
    make_average,
    make_optimizer,
    optimizer_settings,
    optimizer_tensors,
    restore_optimizer,
    update_average,
)
from imgcal.training.state import TrainingState, load_state, random_states, restore_random_states, save_state
from imgcal.types import CalibrationObject, CameraRig

RESULT, STATE, RESOLVED, BAD_BATCH = "model.safetensors", "state.safetensors", "resolved.yaml", "bad_batch.safetensors"

WINDOW = ("losses", "passes")  # names of `Run.window`'s columns in the state

# Seeds of what must not depend on how long the training takes: validation rigs.
VALIDATION_SEED = 20_000_003


@dataclass
class Run:
    """A training under way."""

    experiment: Experiment
    folder: Path
    accelerator: Accelerator
    factory: CameraRig  # float64
    network: nn.Module  # as it is trained: wrapped when there are several processes
    plain: nn.Module  # the same without the wrapping
    optimizer: torch.optim.Optimizer
    schedule: Schedule
    average: nn.Module | None  # running mean of the weights
    source: Source
    prior_std: Tensor  # (C, 15) of the drift
    generator: torch.Generator  # of this process's data
    validation: list[Snapshots]
    batch_size: int  # of this process
    untrained: tuple[str, ...]  # parameters that a warm start did not find
    step: int = 0
    elapsed: float = 0.0  # s, of all sessions until this one began
    began: float = field(default_factory=lambda: monotonic())
    judged: Tensor | None = None  # (2,) sum of losses and their number since the schedule last judged
    window: list[tuple[Tensor, Tensor]] = field(default_factory=list)  # losses and mean RE of passes since the last log
    pending: tuple[Batch, Tensor] | None = None  # last batch, its (2,) loss and gradient norm: not yet looked at

    @property
    def seconds(self) -> float:
        """Time spent on the training, all sessions together."""
        return self.elapsed + monotonic() - self.began

    @property
    def best_weights(self) -> nn.Module:
        """The network that is the result: the running mean where there is one."""
        return self.plain if self.average is None else self.average


def train(
    experiment: Experiment,
    folder: str | Path,
    resume: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
) -> Run:
    """Train the network of an experiment.

    Args:
        experiment: what to train, on what, for how long.
        folder: gets model.safetensors, state.safetensors, resolved.yaml, metrics.jsonl and TensorBoard's files.
        resume: go on from `folder`/state.safetensors.
        should_stop: asked after every step of the main process; True = save and return early.

    Returns:
        The run as it ended; `finished(run, run.seconds)` tells whether it came to its end.

    Raises:
        InputError: unusable experiment, checkpoint or folder.
        RefusedError: the loss or its gradient is not finite; the batch is saved.
    """
    run = prepare(experiment, Path(folder), resume)
    if run.accelerator.is_main_process:
        run.folder.mkdir(parents=True, exist_ok=True)
        save_experiment(experiment, run.folder / RESOLVED)
    log = Log(run.folder, run.step, run.accelerator.is_main_process)
    with log:
        _announce(run, log)
        seconds, stop = run.seconds, False
        logged = (run.step, seconds)
        while not (stop or finished(run, seconds)):
            run.schedule.set_progress(progress(run, seconds))
            train_step(run)
            seconds, stop = _agreed(run, should_stop())
            due = experiment.training
            last = stop or finished(run, seconds)
            extra = run.step % due.log_every != 0
            if last or not extra:
                logged = _log(run, log, logged, seconds, extra)
            extra = run.step % due.validate_every != 0
            if run.validation and (last or not extra):
                validate(run, log, extra)
            if last or run.step % due.save_every == 0:
                save(run, log.last)
    return run


def prepare(experiment: Experiment, folder: Path, resume: bool = False) -> Run:
    """Build everything a run needs: untrained, or as it was when the state in `folder` was saved."""
    settings = experiment.training
    # Without a GPU, accelerate joins several processes only where it is told to stay on the CPU.
    accelerator = Accelerator(cpu=settings.device == "cpu" or not torch.accelerator.is_available())
    device, processes = accelerator.device, accelerator.num_processes
    if settings.batch_size % processes:
        raise InputError(
            f"training: batch_size: found {settings.batch_size}, expected a multiple of the {processes} processes"
        )
    factory, obj = experiment.load_rig(), experiment.load_object()
    torch.manual_seed(settings.seed)
    network = build_network(without_pretrained(experiment) if resume else experiment, factory, obj)
    untrained = () if resume or settings.init_from is None else warm_start(settings.init_from, network)
    plain = network.to(device)
    source = Source(
        factory.to(torch.float32, device),
        object_to(obj, device),
        experiment.drift,
        experiment.poses,
        experiment.corruption,
        cast(ImageOptions | None, network.image_options),
    )
    seed = settings.seed * 4096 + accelerator.process_index
    torch.manual_seed(seed)
    optimizer = make_optimizer(plain, experiment.optimizer)
    average = None if experiment.optimizer.ema is None else make_average(plain)
    run = Run(
        experiment=experiment,
        folder=folder,
        accelerator=accelerator,
        factory=factory,
        network=accelerator.prepare(plain),
        plain=plain,
        optimizer=optimizer,
        schedule=Schedule(optimizer, experiment.schedule),
        average=average,
        source=source,
        prior_std=source.drift.std(factory).to(device, torch.float32),
        generator=torch.Generator(device).manual_seed(seed),
        validation=_validation_rigs(source, settings.validation_rigs, settings.batch_size // processes, device),
        batch_size=settings.batch_size // processes,
        untrained=untrained,
    )
    if resume:
        load(run)
    return run


def train_step(run: Run) -> None:
    """Take one step; nothing here waits for the device but the synthesis of the batch."""
    made = run.source.sample(run.batch_size, run.generator)
    check_finite(run)  # the step before this one: its numbers are there by now
    batch = run.source.show(made, run.generator)
    run.optimizer.zero_grad(set_to_none=True)
    with autocast(run.experiment, run.accelerator.device):
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
        RefusedError: with the place of the batch; the state on disk is from before.
    """
    if run.pending is None:
        return
    batch, numbers = run.pending
    run.pending = None
    loss, norm = numbers.tolist()
    if torch.tensor([loss, norm]).isfinite().all():
        return
    name = BAD_BATCH if run.accelerator.num_processes == 1 else f"{run.accelerator.process_index}_{BAD_BATCH}"
    write_tensors(run.folder / name, batch.tensors(), "imgcal-batch/1", {"step": str(run.step - 1)})
    raise RefusedError(
        f"{run.folder}: step {run.step}: loss {loss:g}, norm of its gradient {norm:g}; the batch is in {name}; "
        f"{STATE}, if there, is from before: go on from it with --resume after changing the experiment, or start again"
    )


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


def validate(run: Run, log: Log, extra: bool) -> None:
    """Log the error of the weights as they would be the result, on rigs that are always the same; see `Log.write`."""
    check_finite(run)
    if not run.accelerator.is_main_process:
        return
    generator = torch.Generator(run.accelerator.device).manual_seed(VALIDATION_SEED)
    batches = (run.source.show(made, generator) for made in run.validation)
    errors = validation_errors(run.best_weights, batches, run.source.obj, run.experiment)
    mean, median = float(errors.mean()), float(errors.median())
    log.write({"step": run.step, "validation_re_px": mean, "validation_re_median_px": median}, extra)
    log.say_summary()


def save(run: Run, metrics: dict[str, Any]) -> None:
    """Write the state, and the network as it would be the result now; all processes must call this together.

    Raises:
        InputError: a file cannot be written; the previous ones survive.
    """
    check_finite(run)
    gathered = {
        name: run.accelerator.gather(state.to(run.accelerator.device)[None])
        for name, state in random_states(run.generator).items()
    }
    judged = None if run.judged is None else run.judged.tolist()
    values = {
        "step": run.step,
        "elapsed": run.seconds,
        "processes": run.accelerator.num_processes,
        "optimizer": optimizer_settings(run.optimizer),
        "schedule": run.schedule.state(),
        "judged": judged,
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
        save_state(run.folder / STATE, TrainingState(tensors, values, run.experiment))
        metrics = {name: value for name, value in metrics.items() if name != "lr"} | {"seconds": run.seconds}
        save_network(run.folder / RESULT, run.best_weights, run.experiment, metrics, rig=run.factory)


def load(run: Run) -> None:
    """Go on where the state in the run's folder was saved.

    Raises:
        InputError: no state there, damaged, or of another experiment or number of processes.
    """
    path = run.folder / STATE
    state = load_state(path, run.experiment)
    values, tensors, index = state.values, state.tensors, run.accelerator.process_index
    if values["processes"] != run.accelerator.num_processes:
        expected = values["processes"]
        raise InputError(f"{path}: found {run.accelerator.num_processes} processes, expected {expected} as before")
    run.plain.load_state_dict(tensors["network"])
    if run.average is not None:
        run.average.load_state_dict(tensors["average"])
    restore_optimizer(run.optimizer, tensors["optimizer"], values["optimizer"])
    run.schedule.restore(values["schedule"])
    restore_random_states(run.generator, {name: rows[index] for name, rows in tensors["random"].items()})
    run.step, run.elapsed, run.began = values["step"], values["elapsed"], monotonic()
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


def _log(run: Run, log: Log, logged: tuple[int, float], seconds: float, extra: bool) -> tuple[int, float]:
    """Write the means since the last time; returns where the next means begin. See `Log.write` for `extra`."""
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
    log.write(row, extra)
    log.show(progress(run, seconds))
    return run.step, seconds


def _validation_rigs(source: Source, rigs: int, batch_size: int, device: torch.device) -> list[Snapshots]:
    generator = torch.Generator(device).manual_seed(VALIDATION_SEED)
    return [source.sample(min(batch_size, rigs - start), generator) for start in range(0, rigs, batch_size)]


def _announce(run: Run, log: Log) -> None:
    count = sum(parameter.numel() for parameter in run.plain.parameters())
    where = f"{run.accelerator.num_processes} x {run.accelerator.device.type}"
    again = f", from step {run.step} on" if run.step else ""
    log.say(f"{run.experiment.name}: {count:,} parameters, {where}{again}")
    if run.untrained:
        parts = sorted({name.partition(".")[0] for name in run.untrained})
        count = len(run.untrained)
        log.say(f"{run.experiment.training.init_from}: nothing fits {count} tensors of {', '.join(parts)}: untrained")
