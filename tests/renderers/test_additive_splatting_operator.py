"""Splats under the transforms of PyTorch: `torch.func`, `torch.compile`, `torch.export`, `opcheck`."""

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from renderers import splat, splat_reference
from renderers.additive_splatting_operator import add_splats, add_splats_gradients

SIZE = (11, 13)


def scene(*batch: int, count: int = 4, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
    random = torch.Generator().manual_seed(5)
    uv = torch.rand(*batch, count, 2, generator=random, dtype=dtype) * 14 - 2
    colours = torch.rand(count, 3, generator=random, dtype=dtype)
    return uv, colours, 0.5 + torch.rand(*batch, count, generator=random, dtype=dtype)


def draw(uv: Tensor, colours: Tensor, sizes: Tensor) -> Tensor:
    return splat(uv, colours, sizes, SIZE)


def reference(uv: Tensor, colours: Tensor, sizes: Tensor) -> Tensor:
    return splat_reference(uv, colours, sizes, SIZE)


def close(found: object, expected: object) -> None:
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
@pytest.mark.parametrize("transform", [torch.func.jacfwd, torch.func.jacrev])
def test_jacobians(batch, transform):
    inputs = scene(*batch)
    for argument in range(3):
        found = transform(draw, argnums=argument)(*inputs)
        close(found, torch.func.jacrev(reference, argnums=argument)(*inputs))


def test_hessian_is_that_of_the_reference():
    uv, colours, sizes = scene(count=2)
    weight = torch.linspace(-1, 1, 3 * SIZE[0] * SIZE[1], dtype=uv.dtype).view(3, *SIZE)

    def energy(path):
        return lambda x: ((path(x, colours, sizes) - weight) ** 2).sum()

    expected = torch.func.hessian(energy(reference))(uv)
    close(torch.func.hessian(energy(draw))(uv), expected)
    close(torch.func.jacrev(torch.func.jacrev(energy(draw)))(uv), expected)


@pytest.mark.parametrize("in_dims", [(0, None, 0), (1, None, 1), (0, 0, None), (None, None, 0)])
def test_vmap_does_what_a_loop_does(in_dims):
    uv, colours, sizes = scene(2, 2)
    sizes = sizes if in_dims[2] is not None else sizes[0]
    colours = torch.stack((colours, colours.flip(0))) if in_dims[1] == 0 else colours
    uv = uv if in_dims[0] is not None else uv[0]

    def part(i):
        given = zip((uv, colours, sizes), in_dims, strict=True)
        return [x if axis is None else x.select(axis, i) for x, axis in given]

    found = torch.func.vmap(draw, in_dims=in_dims)(uv, colours, sizes)
    close(found, torch.stack([draw(*part(i)) for i in range(2)]))


def test_gradients_of_each_sample():
    uv, colours, sizes = scene(5)

    def loss(uv, sizes):
        return draw(uv, colours, sizes).square().sum()

    found = torch.func.vmap(torch.func.grad(loss, argnums=(0, 1)))(uv, sizes)
    leaves = [uv.clone().requires_grad_(), sizes.clone().requires_grad_()]
    close(found, torch.autograd.grad(loss(*leaves), leaves))


def test_forward_mode():
    inputs = scene(2)
    assert torch.autograd.gradcheck(draw, [x.requires_grad_() for x in inputs], check_forward_ad=True, fast_mode=True)


@pytest.mark.parametrize("compositing", ["add", "over"])
@pytest.mark.parametrize("dynamic", [False, True])
def test_compiles_into_one_graph(compositing, dynamic):
    def loss(uv, colours):
        return splat(uv, colours, 1.3, SIZE, compositing=compositing).square().mean((-1, -2))

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager", dynamic=dynamic)
    for count in (3, 4):
        uv, colours, _ = scene(2, count=count)
        found, expected = uv.clone().requires_grad_(), uv.clone().requires_grad_()
        images, wanted = compiled(found, colours), loss(expected, colours)
        close(images, wanted)
        close(torch.autograd.grad(images.sum(), found), torch.autograd.grad(wanted.sum(), expected))


def test_compiles_with_a_buffer():
    uv, colours, sizes = scene(2)
    out = torch.full((2, 3, *SIZE), torch.nan, dtype=uv.dtype)
    compiled = torch.compile(lambda x: splat(x, colours, sizes, SIZE, out=out), fullgraph=True, backend="aot_eager")
    close(compiled(uv), draw(uv, colours, sizes))
    close(out, draw(uv, colours, sizes))


@pytest.mark.parametrize("strict", [False, True])
def test_exports(strict):
    class Draw(torch.nn.Module):
        def forward(self, uv, colours, sizes):
            return draw(uv, colours, sizes)

    inputs = scene(2)
    program = torch.export.export(Draw(), inputs, strict=strict)
    close(program.module()(*inputs), draw(*inputs))
    graphs = [part.graph for part in program.graph_module.modules() if isinstance(part, torch.fx.GraphModule)]
    assert any("add_splats" in str(node.target) for graph in graphs for node in graph.nodes)


class NoValues(TorchDispatchMode):
    """Fails where a tensor's value is read."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        assert func is not torch.ops.aten._local_scalar_dense.default
        return func(*args, **(kwargs or {}))


def test_over_with_one_size_reads_no_values():
    uv, colours, _ = scene(2)
    with NoValues():
        splat(uv, colours, 1.3, SIZE, compositing="over")


def test_over_under_vmap():
    uv, colours, _ = scene(2, 3)

    def over(x):
        return splat(x, colours, 1.3, SIZE, compositing="over")

    close(torch.func.vmap(over)(uv), over(uv))
    close(torch.func.jacfwd(over)(uv), torch.func.jacrev(over)(uv))


def operator_inputs() -> tuple[Tensor, ...]:
    uv, colours, sizes = scene(2)
    weight, visible = torch.ones_like(sizes), torch.ones_like(sizes, dtype=torch.bool)
    return (*(x.detach().requires_grad_() for x in (uv, sizes, weight, colours.expand(2, -1, -1).clone())), visible)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # opcheck itself asks its copies for it
def test_operators_are_sound():
    inputs = operator_inputs()
    torch.library.opcheck(add_splats, (*inputs, *SIZE))
    torch.library.opcheck(add_splats_gradients, (torch.ones(2, 3, *SIZE, dtype=torch.float64), *inputs))


def test_operators_have_the_derivatives_of_the_function():
    *values, visible = operator_inputs()

    def operator(*x):
        return add_splats(*x, visible, *SIZE)

    assert torch.autograd.gradcheck(operator, values, fast_mode=True)
    assert torch.autograd.gradgradcheck(operator, values, fast_mode=True)
