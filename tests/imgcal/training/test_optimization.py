import copy
import math

import pytest
import timm
import torch
from torch import nn

from imgcal.errors import InputError
from imgcal.training.experiment import OptimizerConfig, ScheduleConfig
from imgcal.training.optimization import (
    Schedule,
    cosine,
    freeze,
    make_average,
    make_optimizer,
    optimizer_settings,
    optimizer_tensors,
    restore_optimizer,
    set_training_mode,
    update_average,
)


class Grouped(nn.Module):
    def __init__(self):
        super().__init__()
        self.encoder, self.head, self.scale = nn.Linear(3, 4), nn.Linear(4, 2), nn.Parameter(torch.ones(()))
        self.norm = nn.BatchNorm1d(2)
        self.encoder.bias.requires_grad_(False)

    def parameter_groups(self):
        return {"encoder": self.encoder.parameters(), "heads": self.head.parameters()}

    def forward(self, x):
        return self.norm(self.head(self.encoder(x)) * self.scale)


def test_every_trainable_parameter_has_the_rate_of_its_group():
    network = Grouped()
    config = OptimizerConfig(lr=0.1, learning_rates={"encoder": 0.02}, weight_decay=0.3)
    optimizer = make_optimizer(network, config)
    found = {id(p): (g["name"], g["lr"], g["weight_decay"]) for g in optimizer.param_groups for p in g["params"]}
    expected = {
        network.encoder.weight: ("encoder", 0.02, 0.3),
        network.head.weight: ("heads", 0.1, 0.3),
        network.head.bias: ("heads", 0.1, 0.0),
        network.scale: ("rest", 0.1, 0.0),
        network.norm.weight: ("rest", 0.1, 0.0),
        network.norm.bias: ("rest", 0.1, 0.0),
    }
    assert found == {id(p): value for p, value in expected.items()}
    assert isinstance(optimizer, torch.optim.AdamW)
    assert not isinstance(make_optimizer(network, OptimizerConfig(kind="adam")), torch.optim.AdamW)


def test_an_unknown_group_is_named():
    with pytest.raises(InputError, match="unknown group head, nearest: heads"):
        make_optimizer(Grouped(), OptimizerConfig(learning_rates={"head": 0.1}))


def test_frozen_batch_normalization_keeps_its_means():
    network = Grouped()
    freeze(network, ["rest"])
    assert set_training_mode(network).training and not network.norm.training and network.head.training
    assert not network.norm.weight.requires_grad and network.head.weight.requires_grad
    freeze(other := Grouped(), ["heads"])
    assert set_training_mode(other).norm.training


SMALL = {"embed_dim": 12, "depth": 2, "num_heads": 2}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("vit_tiny_patch16_224", {"num_classes": 0, **SMALL}),
        ("resnet18", {"num_classes": 0, "layers": (1, 1, 1, 1)}),
        ("convnext_atto", {"features_only": True, "depths": (1, 1, 1, 1), "dims": (4, 4, 8, 8)}),
    ],
)
def test_layers_near_the_images_learn_more_slowly(name, options):
    network = Grouped()
    network.encoder = timm.create_model(name, **options)
    optimizer = make_optimizer(network, OptimizerConfig(lr=0.1, layer_decay=0.5, learning_rates={"encoder": 0.2}))
    rates = {id(p): group["lr"] for group in optimizer.param_groups for p in group["params"]}
    found = [rates[id(p)] for p in network.encoder.parameters()]
    assert found == sorted(found) or name.startswith("vit")
    assert min(found) < max(found) <= 0.2 and all(math.log2(0.2 / rate) % 1 == 0 for rate in found)
    assert rates[id(next(network.encoder.parameters()))] == min(found)
    assert rates[id(network.head.weight)] == 0.1
    assert set(rates) == {id(p) for p in network.parameters()}
    with pytest.raises(InputError, match=r"layer_decay: found 0\.5, but no encoder of timm or ours"):
        make_optimizer(Grouped(), OptimizerConfig(layer_decay=0.5))


def test_cosine_with_warmup():
    config = ScheduleConfig(warmup=0.1, final=0.2)
    for progress, expected in ((0.0, 0.0), (0.05, 0.5), (0.1, 1.0), (0.55, 0.6), (1.0, 0.2)):
        assert cosine(progress, config) == pytest.approx(expected)
    assert cosine(0.0, ScheduleConfig(warmup=0.0)) == 1.0
    assert cosine(0.5, ScheduleConfig(warmup=1.0)) == 0.5


def test_cosine_scales_every_group():
    optimizer = make_optimizer(Grouped(), OptimizerConfig(lr=0.1, learning_rates={"encoder": 0.02}))
    Schedule(optimizer, ScheduleConfig(warmup=0.0)).set_progress(0.5)
    assert {group["lr"] for group in optimizer.param_groups} == {0.05, 0.01}


def test_a_plateau_lowers_the_rates_and_survives_a_restart():
    config = ScheduleConfig(kind="plateau", patience=1, factor=0.5)

    def fresh():
        optimizer = make_optimizer(Grouped(), OptimizerConfig(lr=0.1))
        return optimizer, Schedule(optimizer, config)

    optimizer, schedule = fresh()
    for loss in (3.0, 2.0, 2.0):
        schedule.judge(loss)
    schedule.set_progress(0.9)  # says nothing to a plateau
    assert optimizer.param_groups[0]["lr"] == 0.1
    other, again = fresh()
    again.restore(schedule.state())
    for each in (schedule, again):
        each.judge(2.0)
    assert optimizer.param_groups[0]["lr"] == other.param_groups[0]["lr"] == 0.05


def test_the_running_mean():
    network = Grouped()
    average = make_average(network)
    start = average.scale.clone()
    with torch.no_grad():
        network.scale.fill_(5.0)
    network.norm.running_mean.fill_(7.0)
    update_average(average, network, 1, decay=0.999)
    assert average.scale.item() == pytest.approx(start.item() * 2 / 11 + 5.0 * 9 / 11)
    update_average(average, network, 10**6, decay=0.5)
    assert average.scale.item() == pytest.approx(0.5 * (start.item() * 2 / 11 + 5.0 * 9 / 11) + 2.5)
    assert (average.norm.running_mean == 7.0).all()
    assert not any(parameter.requires_grad for parameter in average.parameters())


def test_a_restored_optimizer_takes_the_same_steps():
    torch.manual_seed(0)
    network = Grouped()
    config = OptimizerConfig(lr=0.1, weight_decay=0.01)
    optimizer = make_optimizer(network, config)

    def step(net, opt, seed):
        opt.zero_grad()
        net(torch.randn(5, 3, generator=torch.Generator().manual_seed(seed))).square().mean().backward()
        opt.step()

    for seed in range(3):
        step(network, optimizer, seed)
    twin = copy.deepcopy(network)
    restored = make_optimizer(twin, config)
    restore_optimizer(restored, copy.deepcopy(optimizer_tensors(optimizer)), optimizer_settings(optimizer))
    for net, opt in ((network, optimizer), (twin, restored)):
        step(net, opt, 9)
    assert all(torch.equal(a, b) for a, b in zip(network.parameters(), twin.parameters(), strict=True))
    assert math.isfinite(network.scale.item())
