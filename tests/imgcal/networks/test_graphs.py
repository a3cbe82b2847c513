"""Networks compile into one graph, with their gradient, and export."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils._pytree import tree_leaves

import imgcal.nn  # noqa: F401  value types as pytrees
from imgcal.io import read_rig
from imgcal.networks import NetworkConfig, build
from imgcal.types import CalibrationObject, RigPrior, Views
from renderers import splat

TRUNK = {"width": 16, "heads": 2, "depth": 1, "later_depth": 1, "passes": 2}
POINTS = {
    "points": {"trunk": TRUNK | {"trust": True}},
    "paper-points": {"width": 16, "depth": 1, "head_widths": [16]},
}
IMAGES = {
    "vit": {"trunk": TRUNK, "options": {"embed_dim": 8, "depth": 1, "num_heads": 2}, "width": 8},
    "cnn": {"trunk": TRUNK, "options": {"depths": [1, 1, 1, 1], "dims": [4, 4, 8, 8]}, "width": 8},
}


def make(preset: str, change: dict[str, Any], obj: CalibrationObject) -> nn.Module:
    """Make a small network whose heads say something."""
    random = torch.Generator().manual_seed(0)
    factory = read_rig("T4").to(torch.float32)
    network = build(NetworkConfig(preset=preset, change=change), factory, obj, RigPrior().std(factory), random)
    for parameter in network.parameters():
        if not parameter.any():
            nn.init.normal_(parameter, std=0.01, generator=random)
    return network.eval()


def points() -> Views:
    random = torch.Generator().manual_seed(0)
    return Views(
        uv=200 + 600 * torch.rand(3, 4, 8, 2, generator=random), seen=torch.rand(3, 4, 8, generator=random) > 0.2
    )


def images(obj: CalibrationObject) -> Views:
    uv = 224 * torch.rand(3, 4, 8, 2, generator=torch.Generator().manual_seed(0))
    return Views(images=splat(uv, obj.colours.float(), 1.5, (224, 224)).clamp(0, 1))


def tensors(tree: Any) -> list[Tensor]:
    return [x for x in tree_leaves(tree) if isinstance(x, Tensor)]


@pytest.mark.parametrize("preset", [*POINTS, *(pytest.param(name, marks=pytest.mark.slow) for name in IMAGES)])
def test_compiles_into_one_graph_and_exports(preset: str, asymmetric8: CalibrationObject) -> None:
    network = make(preset, (POINTS | IMAGES)[preset], asymmetric8)
    views = points() if preset in POINTS else images(asymmetric8)
    expected = network(views)
    weights = [p for p in network.parameters() if p.requires_grad]

    def gradient(predictions: Any) -> tuple[Tensor, ...]:
        loss = predictions[-1].rig.focal_length.sum() + predictions[-1].rig_from_object.translation.sum()
        return torch.autograd.grad(loss, weights, allow_unused=True, materialize_grads=True)

    compiled = torch.compile(network, fullgraph=True, backend="aot_eager")(views)
    torch.testing.assert_close(tensors(compiled), tensors(expected), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(gradient(compiled), gradient(expected), rtol=1e-3, atol=1e-2)
    exported = torch.export.export(network, (views,), strict=False).module()(views)
    torch.testing.assert_close(tensors(exported), tensors(expected), rtol=1e-4, atol=1e-4)


def test_gradients_of_each_sample(asymmetric8: CalibrationObject) -> None:
    network, views = make("points", POINTS["points"], asymmetric8), points()
    weights = dict(network.named_parameters())

    def loss(weights: dict[str, Tensor], uv: Tensor, seen: Tensor) -> Tensor:
        predictions = torch.func.functional_call(network, weights, (Views(uv=uv[None], seen=seen[None]),))
        return predictions[-1].rig.focal_length.sum()

    with sdpa_kernel(SDPBackend.MATH):  # the others are not mapped yet: PyTorch would warn, and loop
        each = torch.func.vmap(torch.func.grad(loss), (None, 0, 0))(weights, views.uv, views.seen)
    assert views.uv is not None
    assert views.seen is not None
    total = torch.func.grad(lambda w: sum(loss(w, views.uv[i], views.seen[i]) for i in range(3)))(weights)
    for name, value in total.items():
        torch.testing.assert_close(each[name].sum(0), value, rtol=1e-3, atol=1e-3)
