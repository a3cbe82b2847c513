import torch

from imgcal.networks import Checkpoint, NetworkSpec, load_checkpoint
from imgcal.training.rigs import RigTask, experiment_of


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
    assert experiment_of(found.experiment) == made == experiment_of(made)
    # A model from before there were tasks says nothing of them.
    older = {name: value for name, value in found.experiment.model_dump(mode="json").items() if name != "task"}
    assert experiment_of(NetworkSpec.model_validate(older)).task == "rig"
