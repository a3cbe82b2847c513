import copy
import json
import math
import re
import resource
from dataclasses import replace

import pytest
import torch
from tensorboard.backend.event_processing import event_accumulator

from imgcal.cli.training_folder import BAD_BATCH, RESULT, STATE
from imgcal.errors import InputError, RefusedError
from imgcal.io import read_metrics, read_rig, read_tensors, save_rig
from imgcal.networks import load_checkpoint
from imgcal.training import Callbacks, DivergedError, engine, is_finished, load_experiment, progress, rigs
from imgcal.training.random_streams import make_stream
from tests.imgcal.training.toy import Toy, ToyOfImages, train


def weights(folder):
    return read_tensors(folder / RESULT, "imgcal-network/1")[0]


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def timeless(row):
    """What does not depend on how fast the machine is."""
    return {name: value for name, value in row.items() if name not in ("seconds", "rigs_per_s")}


def logged(folder):
    return [timeless(row) for row in read_metrics(folder / "metrics.jsonl")]


def stopping_at(step):
    """A wish to stop after so many steps of this session."""
    asked = iter(range(1, 10**6))
    return lambda: next(asked) == step


def test_a_training_learns_and_tells(experiment, tmp_path):
    run = train(experiment("training.steps=300", "training.log_every=50", "training.validate_every=150"), tmp_path)
    assert is_finished(run, run.seconds)
    rows = read_metrics(tmp_path / "metrics.jsonl")
    logged = [row for row in rows if "loss" in row]
    assert [row["step"] for row in logged] == [50, 100, 150, 200, 250, 300]
    assert set(logged[0]) == {"step", "loss", "re_px", "re_pass1_px", "lr", "rigs_per_s", "seconds"}
    assert logged[-1]["loss"] < 0.8 * logged[0]["loss"]
    assert logged[-1]["lr"] < 0.01 * logged[0]["lr"]
    validated = [row for row in rows if "validation_re_px" in row]
    assert [row["step"] for row in validated] == [150, 300]
    assert validated[1]["validation_re_px"] < validated[0]["validation_re_px"]
    assert any((tmp_path / "tensorboard").iterdir())
    assert load_experiment(tmp_path / "resolved.yaml") == run.experiment
    found = load_checkpoint(tmp_path / RESULT, run.experiment.load_rig(), run.experiment.load_object())
    assert found.metrics["validation_re_px"] == validated[1]["validation_re_px"]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_refined_loss_is_minimized_with_the_others_and_logged(experiment, tmp_path, monkeypatch, sign):
    """As heavy as this, it alone says where the first step goes: focal lengths become shorter, or longer."""
    once = ("training.steps=1", "training.log_every=1", "training.validation_rigs=0")
    setup = experiment(*once, "optimizer.clip=null", "schedule.warmup=0.0")
    train(setup, tmp_path / "plain")

    def heavy(prediction, batch, source, *_):
        return sign * 1e6 * (prediction.rig.focal_length / source.factory.focal_length).mean()

    monkeypatch.setattr(rigs, "end_to_end_loss", heavy)
    run = train(setup, tmp_path / "more")
    plain, more = (read_metrics(tmp_path / name / "metrics.jsonl")[0]["loss"] for name in ("plain", "more"))
    assert more - plain == pytest.approx(sign * 1e6, rel=1e-6)  # the untrained toy has the factory's focal lengths
    steps = run.plain.head.bias.detach()[:-9].unflatten(0, (run.task.source.factory.num_cameras, -1))[:, 6:8]
    assert (steps * sign < 0).all()


def test_the_result_is_the_running_mean(experiment, tmp_path):
    run = train(experiment("training.steps=5"), tmp_path / "mean")
    assert torch.equal(weights(tmp_path / "mean")["head.weight"], run.average.head.weight)
    assert not torch.equal(run.average.head.weight, run.plain.head.weight)
    run = train(experiment("training.steps=5", "optimizer.ema=null"), tmp_path / "last")
    assert torch.equal(weights(tmp_path / "last")["head.weight"], run.plain.head.weight)


@pytest.mark.parametrize("schedule", ["{kind: cosine}", "{kind: plateau, every: 7, patience: 0}"])
def test_a_resumed_run_ends_bit_for_bit_the_same(experiment, tmp_path, schedule):
    setup = experiment(f"schedule={schedule}", "training.steps=40")
    train(setup, tmp_path / "whole")
    first = train(setup, tmp_path / "parts", should_stop=stopping_at(17))
    assert first.step == 17 and not is_finished(first, first.seconds)
    torch.manual_seed(99)  # what another process has in its default generator
    second = train(setup, tmp_path / "parts", resume=True)
    assert second.step == 40
    assert second.elapsed > 0
    assert same(weights(tmp_path / "whole"), weights(tmp_path / "parts"))
    assert logged(tmp_path / "whole") == logged(tmp_path / "parts")


@pytest.mark.parametrize("stop", [17, 20, 30, 35])
def test_a_run_that_is_killed_and_resumed_logs_what_a_whole_one_logs(experiment, tmp_path, stop):
    setup = experiment("training.steps=40", "training.log_every=4", "training.validate_every=6")
    train(setup, tmp_path / "whole")
    train(setup, tmp_path / "parts", should_stop=stopping_at(stop))
    state = (tmp_path / "parts" / STATE).read_bytes()
    train(setup, tmp_path / "parts", resume=True, should_stop=stopping_at(3))
    (tmp_path / "parts" / STATE).write_bytes(state)  # as a kill before the next state leaves it
    train(setup, tmp_path / "parts", resume=True)
    assert logged(tmp_path / "whole") == logged(tmp_path / "parts")
    assert {row["step"] for row in logged(tmp_path / "parts")} == {*range(4, 41, 4), *range(6, 41, 6)}
    found = [load_checkpoint(tmp_path / name / RESULT).metrics for name in ("whole", "parts")]
    assert timeless(found[0]) == timeless(found[1])


def test_curves_of_a_run_that_was_killed_before_its_first_state_are_not_drawn_again(experiment, tmp_path):
    train(experiment("training.steps=40"), tmp_path)
    (tmp_path / STATE).unlink()
    train(experiment("training.steps=20"), tmp_path)
    board = event_accumulator.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [event.step for event in board.Scalars("loss")] == [10, 20]


def test_a_cut_off_log_is_repaired(experiment, tmp_path):
    setup = experiment("training.steps=30")
    train(setup, tmp_path, should_stop=stopping_at(20))
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write(json.dumps({"step": 25, "loss": 1.0}) + '\n{"step": 2')
    train(setup, tmp_path, resume=True)
    assert [row["step"] for row in read_metrics(tmp_path / "metrics.jsonl") if "loss" in row] == [10, 20, 30]


def test_a_continuation_must_be_of_the_same_experiment(experiment, tmp_path):
    train(experiment("training.steps=20"), tmp_path)
    longer = train(experiment("training.steps=30", "training.log_every=5"), tmp_path, resume=True)
    assert longer.step == 30
    before = (tmp_path / "resolved.yaml").read_text()
    for change, expected in (
        ("optimizer.lr=0.1", r"optimizer\.lr: found 0\.1, expected 0\.003"),
        ("drift={position: 1}", r"drift\.kappa_intrinsics: found None, expected 0\.01"),
        ("training.batch_size=24", r"training\.batch_size: found 24, expected 12"),
    ):
        with pytest.raises(InputError, match=expected):
            train(experiment(change), tmp_path, resume=True)
    assert (tmp_path / "resolved.yaml").read_text() == before


def test_a_continuation_has_the_same_rig_wherever_its_file_lies(experiment, tmp_path):
    (tmp_path / "here").mkdir()
    save_rig(read_rig("T4"), file := tmp_path / "here" / "mine.yaml")
    run = tmp_path / "run"
    train(experiment("training.steps=20", f"rig={file}"), run)
    moved = file.rename(tmp_path / "mine.yaml")
    assert train(experiment("training.steps=22", f"rig={moved}"), run, resume=True).step == 22
    rig = read_rig("T4")
    save_rig(replace(rig, focal_length=rig.focal_length * 1.001), moved)
    with pytest.raises(InputError, match="rig: its file has changed since the training began"):
        train(experiment("training.steps=24", f"rig={moved}"), run, resume=True)


def test_time_moves_the_schedule_and_ends_the_run(experiment, tmp_path, monkeypatch):
    clock = iter(float(second) for second in range(10**6))
    monkeypatch.setattr("imgcal.training.run.monotonic", lambda: next(clock))
    setup = experiment("training={minutes: 1.0, batch_size: 6, validation_rigs: 0, device: cpu, log_every: 1}")
    run = train(setup, tmp_path)
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert rows[-2]["seconds"] < 60 <= rows[-1]["seconds"]
    rates = [row["lr"] for row in rows]
    assert rates[1] == max(rates) and rates[-1] < 0.01 * rates[1]
    assert is_finished(run, 61.0) and progress(run, 30.0) == 0.5


def test_without_a_terminal_there_is_a_line_a_minute_and_one_at_the_end(line, tmp_path, monkeypatch, capsys):
    clock = iter(range(0, 10**6, 7))
    monkeypatch.setattr("imgcal.training.run.monotonic", lambda: float(next(clock)))
    run = train(line("training.steps=null", "training.minutes=5", "training.log_every=3"), tmp_path)
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith(f"step {run.step}  error ") and "left" not in lines[-1]
    told = [line for line in lines if line.endswith("min left")]
    assert 3 <= len(told) <= 4 and re.search(r"  2[0-3] %, 4 min left$", told[0])
    assert len(lines) == len(told) + 2


def test_a_resumed_clock_goes_on(experiment, tmp_path):
    first = train(experiment(), tmp_path, should_stop=stopping_at(5))
    assert train(experiment(), tmp_path, resume=True, should_stop=stopping_at(1)).seconds > first.elapsed


class Diverging(Toy):
    """Turns infinite when it sees its sixth batch in training."""

    seen = 0

    def forward(self, views):
        if self.training:
            self.seen += 1
        predictions = super().forward(views)
        if self.seen == 6:
            predictions[-1].rig.focal_length.mul_(torch.nan)
        return predictions


def test_a_loss_that_is_not_finite_stops_with_the_batch(experiment, tmp_path, monkeypatch):
    monkeypatch.setattr("imgcal.networks.factory.build", Diverging)
    with pytest.raises(RefusedError, match=r"step 6: loss nan, norm of its gradient nan; the batch is in bad_batch"):
        train(experiment("training.save_every=5"), tmp_path)
    tensors, texts = read_tensors(tmp_path / BAD_BATCH, "imgcal-batch/1")
    assert texts["step"] == "5"
    assert tensors["uv"].shape == (12, 4, 8, 2)
    assert tensors["rig_from_object.rotation"].shape == (12, 3, 3)
    assert all(tensor.isfinite().all() for tensor in weights(tmp_path).values())


def test_a_full_disk_leaves_the_previous_state(experiment, tmp_path):
    setup = experiment("training.steps=20")
    train(setup, tmp_path)
    before = (tmp_path / STATE).read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
    try:
        with pytest.raises(InputError, match=f"{STATE}: cannot be written"):
            train(experiment("training.steps=40"), tmp_path, resume=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / STATE).read_bytes() == before
    assert not list(tmp_path.glob(".*"))
    assert train(experiment("training.steps=40"), tmp_path, resume=True).step == 40


@pytest.mark.parametrize("patience", ["null", "9"])
def test_a_finished_training_whose_model_is_missing_writes_it_again(experiment, tmp_path, patience):
    setup = experiment("training.steps=50", f"training.patience={patience}")
    train(setup, tmp_path)
    expected, metrics, rows = weights(tmp_path), load_checkpoint(tmp_path / RESULT).metrics, logged(tmp_path)
    (tmp_path / RESULT).unlink()
    train(setup, tmp_path, resume=True)
    assert same(weights(tmp_path), expected)
    assert load_checkpoint(tmp_path / RESULT).metrics["validation_re_px"] == metrics["validation_re_px"]
    assert logged(tmp_path) == rows


def test_a_model_is_never_older_than_the_state(experiment, tmp_path, monkeypatch):
    def interrupt(path, state):
        raise KeyboardInterrupt

    monkeypatch.setattr("imgcal.cli.training_folder.save_state", interrupt)
    with pytest.raises(KeyboardInterrupt):
        train(experiment("training.steps=20"), tmp_path)
    assert load_checkpoint(tmp_path / RESULT).metrics["step"] == 20


def test_a_warm_start(experiment, tmp_path, capsys):
    train(experiment("training.steps=20"), tmp_path / "a")
    setup = experiment("training.steps=1", "optimizer.ema=null", "drift={kappa_intrinsics: 0.05}", "optimizer.lr=1e-9")
    warm = setup.training.model_copy(update={"init_from": str(tmp_path / "a" / RESULT)})
    run = train(setup.model_copy(update={"training": warm}), tmp_path / "b")
    torch.testing.assert_close(run.plain.head.weight.detach(), weights(tmp_path / "a")["head.weight"])
    torch.testing.assert_close(run.plain.prior_std, setup.drift.std(setup.load_rig()).float())


def test_images_and_bf16(experiment, tmp_path, monkeypatch):
    monkeypatch.setattr("imgcal.networks.factory.build", ToyOfImages)
    setup = experiment("training.precision=bf16", "training.steps=4", "images={size: 20, dot: 1.0}")
    run = train(setup, tmp_path)
    assert run.task.source.images.size == 20
    assert run.plain.head.weight.dtype == torch.float32
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert rows[-1]["validation_re_px"] > 0


def test_bf16_stays_out_of_the_errors(experiment, tmp_path):
    run = train(experiment("training.precision=bf16", "training.steps=1"), tmp_path)
    generator = torch.Generator().manual_seed(1)
    batch = run.task.batch(5, generator)

    class Oracle(torch.nn.Module):
        def forward(self, views):
            return (batch.truth,)

    run.task.validate = lambda predict: {"worst": float(run.task.errors(predict(batch)[-1], batch).max())}
    assert engine.validation(run, Oracle())["worst"] < 1e-3


def test_images_for_a_point_network_are_an_error(experiment, tmp_path, monkeypatch):
    monkeypatch.undo()  # the real networks
    with pytest.raises(InputError, match="the network points takes points"):
        train(experiment("images={size: 32}"), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_the_paper_preset_trains(experiment, tmp_path):
    run = train(experiment("loss={kind: paper, paper: {reprojection_from: 10}}", "optimizer.kind=adam"), tmp_path)
    losses = [row["loss"] for row in read_metrics(tmp_path / "metrics.jsonl") if "loss" in row]
    assert run.step == 60 and losses[-1] < losses[0]


class Recorder(Callbacks):
    """Keeps what it is told."""

    def __init__(self):
        self.told, self.rows, self.state = [], [], None

    def on_start(self, run):
        self.told.append(("start", run.step))

    def on_metrics(self, run, row, due):
        self.told.append(("metrics", run.step))
        self.rows.append((timeless(row), due))

    def on_checkpoint(self, run, state, checkpoint):
        self.told.append(("checkpoint", run.step))
        self.state, self.metrics = copy.deepcopy(state), dict(checkpoint.metrics)

    def on_end(self, run):
        self.told.append(("end", run.step))


def test_a_training_in_memory_writes_nothing_and_leaves_the_default_generator_alone(experiment, tmp_path, monkeypatch):
    setup = experiment("training.steps=40", "training.validate_every=20")
    before, random = sorted(tmp_path.rglob("*")), torch.get_rng_state()
    monkeypatch.chdir(tmp_path)
    whole, parts, rest = Recorder(), Recorder(), Recorder()
    expected = engine.train(setup, whole)
    engine.train(setup, parts, should_stop=stopping_at(17))
    found = engine.train(setup, rest, parts.state)
    assert torch.equal(torch.get_rng_state(), random) and sorted(tmp_path.rglob("*")) == before
    assert torch.equal(found.plain.head.weight, expected.plain.head.weight)
    assert (parts.told[-1], rest.told[-1]) == (("end", 17), ("end", 40))
    assert rest.told[:2] == [("start", 17), ("metrics", 20)]
    due = [row for row, due in parts.rows + rest.rows if due]
    assert due == [row for row, _ in whole.rows] and len(due) == 6
    assert timeless(rest.metrics) == timeless(whole.metrics)


def test_a_training_that_fails_says_that_it_ends(experiment, monkeypatch):
    monkeypatch.setattr("imgcal.networks.factory.build", Diverging)
    recorder = Recorder()
    with pytest.raises(DivergedError, match="step 6: loss nan") as caught:
        engine.train(experiment(), recorder)
    assert recorder.told == [("start", 0), ("end", 6)]
    assert caught.value.batch.views.uv.shape == (12, 4, 8, 2) and caught.value.process is None


@pytest.fixture
def saying(monkeypatch):
    """Let validations find these errors, the last one again and again."""

    def say(*errors):
        left = list(errors)
        monkeypatch.setattr(
            rigs.RigTask, "validate", lambda self, predict: {self.judged: left.pop(0) if left[1:] else left[0]}
        )

    return say


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_an_error_that_is_no_number_is_never_the_best(experiment, saying, wrong, tmp_path):
    setup = experiment("training.validate_every=10", "training.patience=3", "training.steps=60")
    saying(wrong, wrong, 2.0, wrong, 1.0, 3.0)
    run = train(setup, tmp_path)
    assert run.best.metrics["step"] == 50
    assert load_checkpoint(tmp_path / RESULT).metrics["validation_re_px"] == 1.0


def test_it_counts_as_no_better_and_goes_on_from_a_state(experiment, saying, tmp_path):
    setup = experiment("training.validate_every=10", "training.patience=2", "training.steps=60")
    saying(math.nan)
    with pytest.raises(RefusedError, match="validation_re_px is nan"):
        train(setup, tmp_path / "whole")
    run = train(setup, tmp_path / "parts", should_stop=stopping_at(15))
    assert run.best.error == math.inf
    saying(4.0)
    run = train(setup, tmp_path / "parts", resume=True)
    assert run.best.error == 4.0


def test_a_training_whose_result_is_of_no_use_says_so(experiment, saying, tmp_path):
    saying(1.0, math.nan)
    with pytest.raises(RefusedError, match=f"{tmp_path}: step 60: validation_re_px is nan, expected a finite number"):
        train(experiment(), tmp_path)
    assert load_checkpoint(tmp_path / RESULT).metrics["step"] == 40  # from before


def test_weights_that_are_not_finite_are_no_result(experiment, tmp_path, monkeypatch):
    step = engine.train_step

    def broken(run):
        step(run)
        if run.step == 60:
            run.average.head.bias.data[0] = math.inf

    monkeypatch.setattr(engine, "train_step", broken)
    with pytest.raises(RefusedError, match=r"found weights that are not finite \(head.bias\)"):
        train(experiment("training.validation_rigs=0"), tmp_path)


def test_weights_data_and_dropout_are_streams_of_their_own(experiment, monkeypatch):
    weights, make = [], Toy.__init__

    def note(self, config, factory, obj, drift_std, generator, images=None):
        weights.append(generator.get_state())
        make(self, config, factory, obj, drift_std, generator, images)

    monkeypatch.setattr(Toy, "__init__", note)
    run = engine.prepare(experiment("training.seed=0"))
    states = [weights[0], run.generator.get_state(), run.dropout[0].get_state()]
    expected = [make_stream(purpose, 0).get_state() for purpose in ("weights", "data", "layers")]
    assert all(torch.equal(found, state) for found, state in zip(states, expected, strict=True))


def test_dropout_follows_the_seed_on_a_cpu_with_a_number(experiment, monkeypatch):
    """Accelerate names the CPU `cpu:0` if there are several processes."""
    monkeypatch.setattr(engine.Accelerator, "device", torch.device("cpu", 0))
    found = []
    for default in (0, 1):
        torch.manual_seed(default)
        run = engine.prepare(experiment("training.validation_rigs=0"))
        for _ in range(3):
            engine.train_step(run)
        found.append(run.plain.head.weight.detach())
    assert torch.equal(*found)
