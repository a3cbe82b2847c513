"""An operator of one's own, with control flow that depends on values, under every transform."""

import pytest
import torch
from torch import Tensor

from imgcal.operators import Operator, Tensors


def root(inputs: Tensors, options: str) -> Tensors:
    """Newton's iteration for y^n = a (b + c^2): how many steps it takes depends on the values."""
    a, b, c, kind = inputs
    power = int(options)
    target = a * (b + c.square()).sum(-1)
    y, steps = torch.ones_like(target), 0
    while bool(((y**power - target).abs() > 1e-13).any()) and steps < 200:
        y, steps = y - (y**power - target) / (power * y ** (power - 1)), steps + 1
    return y, y * kind.to(y), torch.full_like(kind, steps)


def attach(inputs: Tensors, outputs: Tensors, options: str) -> Tensors:
    a, b, c, kind = inputs
    power, y = int(options), outputs[0]
    target = a * (b + c.square()).sum(-1)
    y = y + (target - target.detach()) / (power * y ** (power - 1))
    return y, y * kind.to(y), outputs[2]


def like(inputs: Tensors, options: str) -> Tensors:
    a, _, _, kind = inputs
    return torch.empty_like(a), torch.empty_like(a), torch.empty_like(kind)


NEWTON = Operator(
    name="test_newton",
    inputs=("a", "b", "c", "kind"),
    outputs=("y", "z", "steps"),
    differentiable=frozenset(("a", "b", "c", "y", "z")),
    batched=frozenset(("a", "b", "kind", "y", "z", "steps")),
    compute=root,
    attach=attach,
    like=like,
)


def given(batch: int = 3) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    random = torch.Generator().manual_seed(1)
    a, b, c = (1 + torch.rand(*shape, generator=random, dtype=torch.float64) for shape in ((batch,), (batch, 4), (4,)))
    return a, b, c, torch.arange(batch) + 1


def newton(a: Tensor, b: Tensor, c: Tensor, kind: Tensor) -> tuple[Tensor, Tensor]:
    y, z, _ = NEWTON(a, b, c, kind, options="3")
    return y, z


def reference(a: Tensor, b: Tensor, c: Tensor, kind: Tensor) -> tuple[Tensor, Tensor]:
    y = (a * (b + c.square()).sum(-1)) ** (1 / 3)
    return y, y * kind


def close(found: object, expected: object) -> None:
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_gradcheck_in_both_directions():
    a, b, c, kind = given()
    leaves = [x.requires_grad_() for x in (a, b, c)]
    assert torch.autograd.gradcheck(lambda *x: newton(*x, kind), leaves, check_forward_ad=True)


@pytest.mark.parametrize("transform", [torch.func.jacfwd, torch.func.jacrev])
def test_jacobians(transform):
    inputs = given()
    close(transform(newton, argnums=(0, 1, 2))(*inputs), transform(reference, argnums=(0, 1, 2))(*inputs))


@pytest.mark.parametrize("axes", [(0, 0, None, 0), (0, 0, 0, None), (None, 1, None, None)])
def test_vmap(axes):
    inputs = given()
    mapped = [
        x if axis is None else torch.stack((x, x + 1, x + 2, x + 3), axis) for x, axis in zip(inputs, axes, strict=True)
    ]
    close(torch.func.vmap(newton, axes)(*mapped), torch.func.vmap(reference, axes)(*mapped))

    def loss(path):
        return lambda *x: path(*x)[1].square().sum()

    for_each = [torch.func.vmap(torch.func.grad(loss(path), argnums=(0, 1)), axes) for path in (newton, reference)]
    close(for_each[0](*mapped), for_each[1](*mapped))


def test_a_batch_is_not_a_loop(monkeypatch):
    inputs, calls = given(), []
    compute = NEWTON.compute
    monkeypatch.setitem(NEWTON.__dict__, "compute", lambda *x: calls.append(1) or compute(*x))
    torch.func.vmap(newton, (0, 0, None, 0))(*(torch.stack((x, x)) if i != 2 else x for i, x in enumerate(inputs)))
    assert len(calls) == 1


def test_compiles_into_one_graph_with_its_gradient():
    inputs = given()
    compiled = torch.compile(newton, fullgraph=True, backend="aot_eager")
    leaves = [x.clone().requires_grad_() for x in inputs[:3]]
    expected = [x.clone().requires_grad_() for x in inputs[:3]]
    found, wanted = compiled(*leaves, inputs[3]), reference(*expected, inputs[3])
    close(found, wanted)
    close(torch.autograd.grad(found[1].sum(), leaves), torch.autograd.grad(wanted[1].sum(), expected))


def test_exports():
    class Newton(torch.nn.Module):
        def forward(self, a, b, c, kind):
            return newton(a, b, c, kind)

    program = torch.export.export(Newton(), given())
    close(program.module()(*given()), reference(*given()))


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # opcheck itself asks its copies for it
def test_is_sound():
    a, b, c, kind = given()
    leaves = [x.requires_grad_() for x in (a, b, c)]
    assert torch.autograd.gradcheck(lambda *x: torch.ops.imgcal.test_newton(*x, kind, "3")[:2], leaves)
    torch.library.opcheck(torch.ops.imgcal.test_newton.default, (*leaves, kind, "3"))


def test_second_derivatives_are_refused():
    a, b, c, kind = given()
    (first,) = torch.autograd.grad(newton(a.requires_grad_(), b, c, kind)[0].sum(), a, create_graph=True)
    with pytest.raises(NotImplementedError, match="second derivatives of imgcal::test_newton"):
        torch.autograd.grad(first.sum(), a)


DOUBLE = Operator(
    name="test_double",
    inputs=("a",),
    outputs=("b", "c"),
    differentiable=frozenset("ab"),
    batched=frozenset("abc"),
    compute=lambda inputs, options: (2 * inputs[0], inputs[0] + 0),
    attach=lambda inputs, outputs, options: (2 * inputs[0], outputs[1]),
    like=lambda inputs, options: (torch.empty_like(inputs[0]), torch.empty_like(inputs[0])),
)


def test_one_input_that_is_differentiable():
    a = torch.arange(3.0, requires_grad=True)
    compiled = torch.compile(lambda x: DOUBLE(x)[0].sum(), fullgraph=True, backend="aot_eager")
    close(torch.autograd.grad(compiled(a), a)[0], torch.full((3,), 2.0))
    close(torch.func.jacrev(lambda x: DOUBLE(x)[0])(a), 2 * torch.eye(3))
    close(torch.func.jacfwd(lambda x: DOUBLE(x)[0])(a), 2 * torch.eye(3))
