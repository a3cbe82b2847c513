from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from imgcal.errors import InputError
from imgcal.networks import Checkpoint, NetworkSpec, load_checkpoint
from imgcal.training import RigTask, checkpoint_experiment, data
from imgcal.types import CameraRig
from tests.imgcal.training.toy import ToyOfImages


def task_of(experiment, **how):
    weights = torch.Generator().manual_seed(3)
    return experiment.make_task(torch.device("cpu"), 7, weights, **{"fresh": True, **how})


def test_a_batch_depends_on_the_generator_alone(experiment):
    task = task_of(experiment("corruption={noise: 0.3, missing: 0.2}"))
    first, second, other = (task.batch(5, torch.Generator().manual_seed(seed)).tensors() for seed in (1, 1, 2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not torch.equal(first["uv"], other["uv"])


def test_validation_shows_the_same_rigs_in_parts(experiment):
    """What the network says of 30 rigs in batches of 7 is compared with their own truth, every time the same."""
    task, seen = task_of(experiment("training.validation_rigs=30", "corruption={noise: 0.3}")), []

    def truth(batch):
        seen.append(batch.views.uv)
        return (batch.truth,)

    assert max(task.validate(truth).values()) < 1e-6
    assert task.validate(truth) == task.validate(truth)
    assert [len(uv) for uv in seen] == [7, 7, 7, 7, 2] * 3
    assert torch.equal(torch.cat(seen[:5]), torch.cat(seen[5:10]))
    with torch.no_grad():
        factory = task.validate(lambda batch: task.predict(task.network.eval(), batch))
    assert factory[RigTask.judged] > 10
    assert not task_of(experiment("training.validation_rigs=0")).validate(truth)


def test_validation_corrupts_rigs_by_other_random_numbers_than_it_draws_them_with(experiment, monkeypatch):
    begun = []
    for name in ("sample", "show"):

        def note(self, made, generator, plain=getattr(data.Source, name)):
            begun.append(generator.get_state())
            return plain(self, made, generator)

        monkeypatch.setattr(data.Source, name, note)
    task = task_of(experiment("training.validation_rigs=7", "corruption={noise: 0.3}"))
    task.validate(lambda batch: (batch.truth,))
    assert len(begun) == 2 and not torch.equal(*begun)


def test_levels_that_would_have_no_effect_are_refused(experiment, monkeypatch):
    with pytest.raises(InputError, match=r"levels: found \[0, 1\], but the network points takes points"):
        task_of(experiment("levels=[0, 1]"))
    monkeypatch.setattr("imgcal.networks.factory.build", ToyOfImages)
    task_of(experiment("levels=[0, 1]"))
    with pytest.raises(InputError, match="levels: found together with `corruption`, expected one of them"):
        task_of(experiment("levels=[0, 1]", "corruption.noise=1"))


def test_the_loss_is_told_pass_by_pass(experiment):
    task = task_of(experiment())
    batch = task.batch(4, torch.Generator().manual_seed(0))
    loss = task.loss(task.predict(task.network, batch), batch, 0)
    assert loss.total.requires_grad and list(loss.means) == ["re_px", "re_pass1_px"]
    assert set(task.headline) <= {*loss.means, *task.validate(lambda batch: (batch.truth,))}
    assert float(task.loss((batch.truth,), batch, 0).means["re_px"]) < 1e-6


def test_a_result_is_a_file_of_a_network(experiment, tmp_path):
    made = experiment()
    task = task_of(made, fresh=False)
    result = task.result(task.network, {"re_px": 1.5})
    assert isinstance(result, Checkpoint)
    result.save(tmp_path / "model.safetensors")
    found = load_checkpoint(tmp_path / "model.safetensors")
    assert found.metrics == {"re_px": 1.5}
    assert checkpoint_experiment(found.experiment) == made == checkpoint_experiment(made)
    # A model from before there were tasks says nothing of them.
    older = {name: value for name, value in found.experiment.model_dump(mode="json").items() if name != "task"}
    assert checkpoint_experiment(NetworkSpec.model_validate(older)).task == "rig"


class NoWaiting(TorchDispatchMode):
    """Refuses what makes a GPU's host wait: values of tensors, and shapes that depend on them."""

    def __torch_dispatch__(self, function, types, arguments=(), keywords=None):
        assert function.__name__.split(".")[0] not in ("_local_scalar_dense", "nonzero", "masked_select", "equal")
        return function(*arguments, **(keywords or {}))


@pytest.mark.parametrize("preset", ["points", "paper-points", "paper-vit"])
def test_a_step_on_a_gpu_waits_for_nothing(experiment, monkeypatch, preset):
    """What a step does there: rigs that are made at once, projected and drawn by tensors, judged, differentiated."""
    monkeypatch.undo()  # the real networks
    small = {"points": "trunk: {width: 16, heads: 2, depth: 1, later_depth: 1}", "paper-points": "width: 16, depth: 1"}
    vit = "backbone: vit_tiny_patch16_224, options: {img_size: 32, embed_dim: 12, depth: 1, num_heads: 2}"
    made = experiment(
        f"network={{preset: {preset}, change: {{{small.get(preset, vit)}}}}}",
        f"loss={{kind: {'robust' if preset == 'points' else 'paper'}}}",
        "training.validation_rigs=0",
        "corruption={noise: 0.1, missing: 0.1, swapped: 0.1, false: 0.1}",
    )
    task = task_of(made)
    task.source = replace(task.source, good=0.5)
    monkeypatch.setattr(CameraRig, "project_values", lambda rig, points, radius=None: rig.project(points, radius))
    monkeypatch.setattr(data, "render_views", drawn_by_tensors)
    with NoWaiting():
        batch = task.batch(3, torch.Generator().manual_seed(0))
        task.loss(task.predict(task.network, batch), batch, 20_000).total.backward()
    with pytest.raises(AssertionError), NoWaiting():
        task.source = replace(task.source, good=None)
        task.batch(3, torch.Generator().manual_seed(0))


def drawn_by_tensors(uv, seen, size, obj, options, **_):
    return torch.zeros(*uv.shape[:2], 3, options.size, options.size) + uv.mean() * seen.float().mean()
