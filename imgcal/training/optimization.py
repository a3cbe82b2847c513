"""Optimizers by group of parameters, schedules of learning rates, the running mean of weights."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import ReduceLROnPlateau

from imgcal.errors import InputError
from imgcal.io import nearest
from imgcal.training.experiment import OptimizerConfig, ScheduleConfig

Module = TypeVar("Module", bound=nn.Module)


def make_optimizer(network: nn.Module, config: OptimizerConfig) -> torch.optim.Optimizer:
    """Create Adam or AdamW; every group of the network's parameters may have its own learning rate.

    Args:
        network: may have `parameter_groups()`, a mapping of names to parameters; otherwise all are the group `network`.
        config: learning rates by group, weight decay of matrices.

    Raises:
        InputError: a learning rate for a group that the network does not have.
    """
    groups = group_parameters(network)
    _check_names(config.learning_rates, groups, "learning_rates")
    scales = layer_scales(network, config.layer_decay)
    settings = []
    for name, parameters in groups.items():
        base = config.learning_rates.get(name, config.lr)
        kinds: dict[tuple[float, bool], list[nn.Parameter]] = {}
        for parameter in parameters:
            kinds.setdefault((scales.get(parameter, 1.0), parameter.ndim > 1), []).append(parameter)
        for kind in sorted(kinds, reverse=True):
            scale, matrices = kind
            lr, decay = base * scale, config.weight_decay if matrices else 0.0
            settings.append({"params": kinds[kind], "name": name, "lr": lr, "initial_lr": lr, "weight_decay": decay})
    optimizers = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}
    first, second = config.betas
    return optimizers[config.kind](settings, betas=(first, second), fused=True)


def group_parameters(network: nn.Module) -> dict[str, list[nn.Parameter]]:
    """Group the trainable parameters of a network; those that `parameter_groups()` omits are the group `rest`.

    The list of a frozen group is empty.
    """
    given: Callable[[], Mapping[str, Iterable[nn.Parameter]]] | None = getattr(network, "parameter_groups", None)
    groups = {"network": network.parameters()} if given is None else given()
    named = {name: list(parameters) for name, parameters in groups.items()}
    known = {id(p) for parameters in named.values() for p in parameters}
    named["rest"] = [p for p in network.parameters() if id(p) not in known]
    return {name: [p for p in parameters if p.requires_grad] for name, parameters in named.items() if parameters}


def freeze(network: nn.Module, names: Iterable[str]) -> None:
    """Freeze the weights of some groups of a network.

    Raises:
        InputError: an unknown group, or nothing is left to train.
    """
    groups, names = group_parameters(network), tuple(names)
    _check_names(names, groups, "freeze")
    for name in names:
        for parameter in groups[name]:
            parameter.requires_grad_(False)
    if not any(parameter.requires_grad for parameter in network.parameters()):
        raise InputError(f"optimizer: freeze: found {', '.join(names)}, which leaves nothing to train")


def set_training_mode(network: nn.Module) -> nn.Module:
    """Put a network into training mode, except frozen batch normalization: its running means count as weights."""
    network.train()
    for module in network.modules():
        own = list(module.parameters(recurse=False))
        if isinstance(module, nn.modules.batchnorm._BatchNorm) and own and not any(p.requires_grad for p in own):
            module.eval()
    return network


def layer_scales(network: nn.Module, decay: float | None) -> dict[nn.Parameter, float]:
    """Learning-rate factor of each parameter of a network's encoders, timm's or ours: decay^(layers after it).

    Raises:
        InputError: there is no such encoder.
    """
    if decay is None:
        return {}
    scales: dict[nn.Parameter, float] = {}
    for encoder in network.modules():
        layers = _layers(encoder)
        scales |= {parameter: decay ** (len(layers) - 1 - n) for n, layer in enumerate(layers) for parameter in layer}
    if not scales:
        raise InputError(f"optimizer: layer_decay: found {decay:g}, but no encoder of timm or ours in the network")
    return scales


def _layers(encoder: Any) -> list[list[nn.Parameter]]:
    """Parameters of a timm model, layer by layer; empty for any other module."""
    if hasattr(encoder, "group_matcher"):
        from timm.models._manipulate import group_with_matcher

        named = dict(encoder.named_parameters())
        numbers = group_with_matcher(iter(named.items()), encoder.group_matcher(coarse=False), reverse=True)
        return [[named[name] for name in numbers if numbers[name] == layer] for layer in sorted({*numbers.values()})]
    if hasattr(encoder, "feature_info") and isinstance(encoder, nn.ModuleDict):  # a model that returns its stages' maps
        return [parameters for stage in encoder.children() if (parameters := list(stage.parameters()))]
    return []


def _check_names(names: Iterable[str], groups: Iterable[str], key: str) -> None:
    for name in names:
        if name not in groups:
            hint = nearest(name, groups) or f", expected one of {', '.join(groups)}"
            raise InputError(f"optimizer: {key}: found the unknown group {name}{hint}")


class Schedule:
    """Set the learning rates of an optimizer by the progress of the run or by a plateau of the loss."""

    def __init__(self, optimizer: torch.optim.Optimizer, config: ScheduleConfig) -> None:
        self.optimizer = optimizer
        self.config = config
        self.plateau = (
            ReduceLROnPlateau(optimizer, factor=config.factor, patience=config.patience, threshold=config.threshold)
            if config.kind == "plateau"
            else None
        )

    def set_progress(self, progress: float) -> None:
        """Set the learning rates of a step at a progress from 0 to 1."""
        if self.config.kind == "cosine":
            factor = cosine(progress, self.config)
            for group in self.optimizer.param_groups:
                group["lr"] = group["initial_lr"] * factor

    def judge(self, loss: float) -> None:
        """Process the mean loss of the last `every` steps; on a plateau, learning rates decrease."""
        if self.plateau is not None:
            self.plateau.step(loss)

    def state(self) -> dict[str, Any]:
        """Return plain values for `restore`."""
        return {} if self.plateau is None else self.plateau.state_dict()

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from another schedule's state; learning rates are part of the optimizer's state."""
        if self.plateau is not None:
            self.plateau.load_state_dict(state)


def cosine(progress: float, config: ScheduleConfig) -> float:
    """Factor of the learning rate: linear warmup, then half a cosine down to `final`."""
    if progress < config.warmup:
        return progress / config.warmup
    along = min((progress - config.warmup) / max(1 - config.warmup, 1e-9), 1.0)
    return config.final + (1 - config.final) * 0.5 * (1 + math.cos(math.pi * along))


def make_average(network: Module) -> Module:
    """Copy a network for the running mean of its weights."""
    average = copy.deepcopy(network)
    average.requires_grad_(False)
    return average


@torch.no_grad()
def update_average(average: nn.Module, network: nn.Module, step: int, decay: float) -> None:
    """Update the running mean with the weights of a step. Early weights are forgotten faster.

    The decay is min(decay, (1 + step) / (10 + step)). The step is a plain number, so that there is no need to wait for
    the device (torch.optim.swa_utils counts in a tensor).
    """
    share = 1 - min(decay, (1 + step) / (10 + step))
    torch._foreach_lerp_(list(average.parameters()), list(network.parameters()), share)
    for mean, latest in zip(average.buffers(), network.buffers(), strict=True):
        mean.copy_(latest)


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Moments and step counts, by `<index of the parameter>.<name>`."""
    state = optimizer.state_dict()["state"]
    return {f"{index}.{name}": value for index, entry in state.items() for name, value in entry.items()}


def optimizer_settings(optimizer: torch.optim.Optimizer) -> list[dict[str, Any]]:
    """Plain values of each group, including learning rates."""
    return optimizer.state_dict()["param_groups"]


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor], settings: list[Any]) -> None:
    """Invert `optimizer_tensors` and `optimizer_settings`."""
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = value
    groups = [{**group, "betas": tuple(group["betas"])} for group in settings]
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for number, entry in state.items():  # copies into the parameter's memory layout, like the optimizer's own
        like = parameters[number]
        entry |= {n: torch.empty_like(like).copy_(t) for n, t in entry.items() if t.shape == like.shape and t.ndim}
    optimizer.load_state_dict({"state": state, "param_groups": groups})
