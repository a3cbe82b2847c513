"""Effects of the keys of `training` and `optimizer` on a run; the task fits a line, which is fast."""

from functools import partial

import pytest
import torch
from torch import nn

from imgcal.errors import InputError
from imgcal.training import Callbacks, engine
from tests.imgcal.training import line as of_line


class Watching(Callbacks):
    """Keeps the last state and result, and what was told of steps."""

    def __init__(self):
        self.steps, self.state, self.result, self.rows = [], None, None, []

    def on_step(self, run, seconds):
        self.steps.append(run.step)

    def on_metrics(self, run, row, due):
        self.rows.append(row)

    def on_checkpoint(self, run, state, result):
        tensors = {part: {name: t.clone() for name, t in named.items()} for part, named in state.tensors.items()}
        self.state = type(state)(tensors, dict(state.values), state.experiment)
        self.result = {name: tensor.clone() for name, tensor in result.network.state_dict().items()}
        self.metrics = result.metrics


def stopping_at(step):
    asked = iter(range(1, 10**6))
    return lambda: next(asked) == step


def test_every_step_is_told(line):
    told = Watching()
    engine.train(line("training.steps=7"), told)
    assert told.steps == list(range(1, 8))


def test_parts_of_a_batch_have_the_gradient_of_their_mean(line):
    setup = line("training.accumulate=3", "optimizer.ema=null", "optimizer.clip=null", "schedule.kind=constant")
    run = engine.prepare(setup)
    assert run.batch_size == 2
    twin, random = of_line.LineTask(setup), torch.Generator().manual_seed(0)
    random.set_state(run.generator.get_state())
    batches = [twin.batch(2, random) for _ in range(3)]
    losses = torch.stack([twin.loss(twin.network(batch.x), batch, 0).total for batch in batches])
    losses.mean().backward()
    engine.train_step(run)
    for mine, other in zip(run.plain.parameters(), twin.network.parameters(), strict=True):
        torch.testing.assert_close(mine.grad, other.grad)
    torch.testing.assert_close(run.window[0]["loss"], losses.mean().detach())
    with pytest.raises(InputError, match="found 6, expected a multiple of the 1 processes and 4 parts"):
        engine.prepare(line("training.accumulate=4"))


def test_a_run_in_parts_of_batches_continues_exactly(line):
    setup, whole, parts, rest = line("training.accumulate=2"), Watching(), Watching(), Watching()
    engine.train(setup, whole)
    engine.train(setup, parts, should_stop=stopping_at(13))
    engine.train(setup, rest, parts.state)
    assert all(torch.equal(whole.result[name], rest.result[name]) for name in whole.result)


def test_the_part_that_is_not_finite_is_named(line, monkeypatch):
    batch = of_line.LineTask.batch

    def broken(self, count, generator):
        made = batch(self, count, generator)
        made.y[made.y > 9] = torch.inf  # some batches, whenever they are made
        return made

    monkeypatch.setattr(of_line.LineTask, "batch", broken)
    with pytest.raises(engine.DivergedError) as caught:
        engine.train(line("training.accumulate=3", "training.steps=300", "training.log_every=1000"))
    assert caught.value.batch.y.isinf().any() and 1 < caught.value.step < 300


ENDLESS = ("training.steps=1000", "training.validate_every=5", "training.save_every=5", "schedule.kind=constant")


def test_a_run_that_gets_no_better_ends_with_the_best_weights(line, monkeypatch):
    """The rate is so high that the line overshoots for ever."""
    setup = line(*ENDLESS, "training.patience=4", "optimizer={lr: 0.8, ema: null}")
    told, parts, rest = Watching(), Watching(), Watching()
    run = engine.train(setup, told)
    errors = {row["step"]: row["validation_slope"] for row in told.rows if "validation_slope" in row}
    best = min(errors, key=errors.get)
    assert run.step == best + 20 < 1000 and engine.is_finished(run, run.seconds)
    assert errors[run.step] > errors[best] == told.metrics["validation_slope"] and told.metrics["step"] == best
    assert abs(float(told.result["weight"]) - 3.0) == pytest.approx(errors[best], abs=1e-5)
    engine.train(setup, parts, should_stop=stopping_at(best + 7))
    again = engine.train(setup, rest, parts.state)
    assert again.step == run.step and rest.metrics["step"] == best
    assert all(torch.equal(told.result[name], rest.result[name]) for name in told.result)
    engine.train(setup, rest, rest.state)  # ended is ended
    assert rest.steps[-1] == run.step
    monkeypatch.setattr(of_line.LineTask, "validate", lambda self, predict: {})
    with pytest.raises(InputError, match="patience: found no validation_slope"):
        engine.train(setup)


def test_weights_that_are_best_when_the_run_ends_are_the_result(line):
    """The last steps lie behind the last validation that was due, and count nonetheless; a continuation is the same."""
    often = ("training.patience=4", "training.validate_every=15", "optimizer={lr: 0.05, ema: null}")
    told, longer, parts, rest = Watching(), Watching(), Watching(), Watching()
    engine.train(line("training.steps=40", "schedule.kind=constant", *often), told)
    errors = {row["step"]: row["validation_slope"] for row in told.rows if "validation_slope" in row}
    assert list(errors) == [15, 30, 40] and errors[40] < errors[30]
    assert told.metrics["step"] == 40 and told.metrics["validation_slope"] == errors[40]
    assert abs(float(told.result["weight"]) - 3.0) == pytest.approx(errors[40], abs=1e-5)
    engine.train(line("training.steps=50", "schedule.kind=constant", *often), longer)
    engine.train(line("training.steps=50", "schedule.kind=constant", *often), parts, should_stop=stopping_at(40))
    assert parts.state.values["best"]["metrics"]["step"] == 30
    engine.train(line("training.steps=50", "schedule.kind=constant", *often), rest, parts.state)
    assert all(torch.equal(longer.result[name], rest.result[name]) for name in longer.result)


def test_a_result_is_told_by_the_numbers_of_its_own_weights(line):
    """With and without patience: nothing of other steps, which had other weights."""
    often = ("training.log_every=5", "training.validate_every=10", "training.save_every=15", "schedule.kind=constant")
    overshooting = (*ENDLESS, "training.log_every=5", "training.patience=4", "optimizer={lr: 0.8, ema: null}")
    for setup in (line("training.steps=45", *often), line("training.steps=40", *often), line(*overshooting)):
        told = Watching()
        run = engine.train(setup, told)
        step = told.metrics["step"]
        own = {name: value for row in told.rows if row["step"] == step for name, value in row.items() if name != "lr"}
        assert {"error", "validation_slope"} <= told.metrics.keys() == own.keys()
        assert own == {**told.metrics, "seconds": own["seconds"]}
        assert told.metrics["seconds"] <= run.seconds
    parts = Watching()
    engine.train(line("training.steps=100", *often), parts, should_stop=stopping_at(44))
    engine.train(line("training.steps=100", *often), parts, parts.state, should_stop=stopping_at(2))
    assert parts.metrics["step"] == 46
    between = Between()
    engine.train(line("training.steps=40", *often), between)
    assert between.results[0] == (15, {"step", "seconds", "loss", "error", "points_per_s"})  # validated at 10 and 20


class Between(Callbacks):
    """Keeps which metrics each result has."""

    def __init__(self):
        self.results = []

    def on_checkpoint(self, run, state, result):
        self.results.append((run.step, set(result.metrics)))


def test_a_continuation_without_patience_ends_with_its_last_weights(line):
    often = (*ENDLESS, "optimizer={lr: 0.8, ema: null}")
    patient, rest, again = Watching(), Watching(), Watching()
    engine.train(line(*often, "training.patience=40"), patient, should_stop=stopping_at(60))
    assert patient.metrics["step"] < 60
    run = engine.train(line(*often), rest, patient.state, should_stop=stopping_at(10))
    assert rest.metrics["step"] == run.step == 70
    assert all(torch.equal(rest.result[name], tensor) for name, tensor in run.plain.state_dict().items())
    assert rest.state.values["best"] is None and not rest.state.tensors["best"]
    engine.train(line(*often, "training.patience=40"), again, rest.state, should_stop=stopping_at(10))
    assert again.metrics["step"] > 70  # what was best before was forgotten


def test_patience_needs_validations(line):
    with pytest.raises(InputError, match="training: found patience 3 and validation_rigs 0, expected at least 1"):
        line("training.patience=3", "training.validation_rigs=0")


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # Dynamo's own
def test_a_compiled_network_trains_as_a_plain_one_and_is_saved_alike(line, monkeypatch):
    def compiled_call(network, mode):
        network._compiled_call_impl = eager(network._call_impl)

    eager = partial(torch.compile, backend="eager")  # the backend costs what it is good for
    monkeypatch.setattr(torch, "compile", lambda function, mode: eager(function))
    monkeypatch.setattr(nn.Module, "compile", compiled_call)
    plain, compiled = Watching(), Watching()
    engine.train(line("training.steps=3"), plain)
    run = engine.train(line("training.steps=3", "training.compile=true"), compiled)
    assert run.plain._compiled_call_impl is not None
    assert plain.result.keys() == compiled.result.keys()
    for name in plain.result:
        torch.testing.assert_close(plain.result[name], compiled.result[name])


def test_another_memory_order_is_kept_over_a_continuation(line, monkeypatch):
    class Convolution(of_line.LineTask):
        def __init__(self, experiment):
            super().__init__(experiment)
            torch.manual_seed(1)
            self.network = nn.Sequential(nn.Unflatten(1, (1, 1, 1)), nn.Conv2d(1, 2, 2, padding=1), nn.Flatten())
            self.network.append(nn.Linear(8, 1))

    monkeypatch.setattr(of_line, "LineTask", Convolution)
    setup = line("training.channels_last=true", "optimizer.kind=adam")
    whole, parts, rest = Watching(), Watching(), Watching()
    engine.train(setup, whole)
    engine.train(setup, parts, should_stop=stopping_at(13))
    run = engine.train(setup, rest, parts.state)
    weight = run.plain[1].weight
    assert weight.is_contiguous(memory_format=torch.channels_last)
    assert run.optimizer.state[weight]["exp_avg"].stride() == weight.stride()
    assert all(torch.equal(whole.result[name], rest.result[name]) for name in whole.result)


def test_frozen_groups_stay(line, monkeypatch):
    monkeypatch.setattr(
        nn.Linear, "parameter_groups", lambda self: {"slope": [self.weight], "offset": [self.bias]}, False
    )
    told = Watching()
    engine.train(line("optimizer.freeze=[offset]", "optimizer.learning_rates={offset: 0.1}"), told)
    assert told.result["bias"] == 0 and told.result["weight"] != 0
    for frozen, message in (
        ("[ofset]", "unknown group ofset, nearest: offset"),
        ("[offset, slope]", "nothing to train"),
    ):
        with pytest.raises(InputError, match=f"optimizer: freeze: found .*{message}"):
            engine.prepare(line(f"optimizer.freeze={frozen}"))
