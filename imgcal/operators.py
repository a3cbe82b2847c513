"""PyTorch operators for functions whose control flow depends on values.

A solver that iterates until it converges, or a list of the pixels that are not black, cannot be traced. As an
`Operator`, such a function is one node of a graph for `torch.compile` and `torch.export`. It has derivatives in both
directions, also under `torch.func.vmap`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

Tensors = tuple[Tensor, ...]

NAMESPACE = "imgcal"


@dataclass(frozen=True, eq=False)
class Operator:
    """A function `(*inputs, options) -> outputs` of tensors; options are a string, such as JSON.

    Attributes:
        name: of the operator, in the namespace `imgcal`.
        inputs: names of the tensors that it takes.
        outputs: names of the tensors that it returns, at least two.
        differentiable: names of the inputs and outputs that have derivatives.
        batched: names of the inputs and outputs whose first axis is a batch. If all outputs and all mapped inputs have
            one, `vmap` makes a single call with a longer batch; otherwise it calls the function once per entry.
        compute: the function, called without gradients.
        attach: `(inputs, outputs, options) -> outputs`: the same values from operations that autograd supports. The
            given outputs are those of `compute`, so that no search is repeated. Only differentiable ones matter.
        like: `(inputs, options) -> outputs` of the right shapes and types, without reading values.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    differentiable: frozenset[str]
    batched: frozenset[str]
    compute: Callable[[Tensors, str], Tensors]
    attach: Callable[[Tensors, Tensors, str], Tensors]
    like: Callable[[Tensors, str], Tensors]

    def __post_init__(self) -> None:
        _register(self)

    def __call__(self, *inputs: Tensor, options: str = "") -> Tensors:
        """Call the function."""
        if torch.compiler.is_compiling():
            found: Tensors = getattr(torch.ops.imgcal, self.name)(*inputs, options)
        else:
            found = _Outputs.apply(self, *inputs, options)
        return found

    @property
    def leaves(self) -> list[str]:
        """Names of the differentiable inputs."""
        return [name for name in self.inputs if name in self.differentiable]

    @property
    def pulled(self) -> list[str]:
        """Names of the tensors that gradients are computed from: inputs, outputs, and gradients of outputs."""
        return [*self.inputs, *self.outputs, *self.select_differentiable(self.outputs, self.outputs)]

    @property
    def pushed(self) -> list[str]:
        """Names of the tensors that tangents are computed from: inputs, outputs, and tangents of inputs."""
        return [*self.inputs, *self.outputs, *self.leaves]

    def select_differentiable(self, names: Sequence[str], values: Iterable[Any]) -> list[Any]:
        """Keep the values of differentiable inputs or outputs."""
        return [value for name, value in zip(names, values, strict=True) if name in self.differentiable]

    def evaluate(self, inputs: Tensors, options: str) -> Tensors:
        """Return the outputs without gradient, as contiguous tensors that are not views."""
        with torch.no_grad():
            found = self.compute(tuple(x.detach() for x in inputs), options)
            return tuple(x.clone(memory_format=torch.contiguous_format) for x in found)

    def gradients(self, inputs: Tensors, outputs: Tensors, upstream: Tensors, options: str) -> Tensors:
        """Pull gradients of differentiable outputs back to differentiable inputs."""
        leaves, pairs = self._attach(inputs, outputs, upstream, options)
        if not pairs:
            return tuple(torch.zeros_like(x, memory_format=torch.contiguous_format) for x in leaves)
        attached, weights = zip(*pairs, strict=True)
        found = torch.autograd.grad(attached, leaves, weights, allow_unused=True, materialize_grads=True)
        return tuple(x.contiguous() for x in found)

    def tangents(self, inputs: Tensors, outputs: Tensors, tangents: Tensors, options: str) -> Tensors:
        """Push tangents of differentiable inputs forward to differentiable outputs.

        Pulling back is linear; its transpose pushes forward.
        """
        weights = tuple(
            torch.zeros_like(x, requires_grad=True) for x in self.select_differentiable(self.outputs, outputs)
        )
        leaves, pairs = self._attach(inputs, outputs, weights, options)
        if not pairs:
            return tuple(torch.zeros_like(x) for x in weights)
        attached, used = zip(*pairs, strict=True)
        pulled = torch.autograd.grad(attached, leaves, used, create_graph=True, allow_unused=True)
        depends = [(p, t) for p, t in zip(pulled, tangents, strict=True) if p is not None and p.requires_grad]
        ends, along = zip(*depends, strict=True)
        found = torch.autograd.grad(ends, weights, along, allow_unused=True, materialize_grads=True)
        return tuple(x.contiguous() for x in found)

    def _attach(
        self, inputs: Tensors, outputs: Tensors, weights: Tensors, options: str
    ) -> tuple[Tensors, list[tuple[Tensor, Tensor]]]:
        """Differentiable inputs, and pairs of an output that depends on them and its weight."""
        with torch.enable_grad():
            given = tuple(
                x.detach().requires_grad_(name in self.differentiable)
                for name, x in zip(self.inputs, inputs, strict=True)
            )
            attached = self.attach(given, tuple(x.detach() for x in outputs), options)
        pairs = zip(self.select_differentiable(self.outputs, attached), weights, strict=True)
        return tuple(self.select_differentiable(self.inputs, given)), [(x, w) for x, w in pairs if x.requires_grad]


def _register(operator: Operator) -> None:
    """Register the operator with PyTorch, and a second one for its gradient."""
    inputs = ", ".join(f"Tensor {name}" for name in operator.inputs)
    outputs = ", ".join(f"Tensor {name}_" for name in operator.outputs)
    upstream = ", ".join(
        f"Tensor by_{name}" for name in operator.select_differentiable(operator.outputs, operator.outputs)
    )
    returned = ", ".join("Tensor" for _ in operator.outputs)
    schema = f"({inputs}, {outputs}, {upstream}, str options) -> Tensor[]"
    name = f"{NAMESPACE}::{operator.name}"

    @torch.library.custom_op(name, mutates_args=(), schema=f"({inputs}, str options) -> ({returned})")
    def forward(*given: Any) -> Tensors:
        return operator.evaluate(given[:-1], given[-1])

    @torch.library.custom_op(f"{name}_gradients", mutates_args=(), schema=schema)
    def backward(*given: Any) -> list[Tensor]:
        return list(_call_with_autograd(lambda: _gradients(operator, *given)))

    @forward.register_fake
    def _(*given: Any) -> Tensors:
        return operator.like(given[:-1], given[-1])

    @backward.register_fake
    def _(*given: Any) -> list[Tensor]:
        likes = operator.select_differentiable(operator.inputs, given[: len(operator.inputs)])
        return [torch.empty_like(x, memory_format=torch.contiguous_format) for x in likes]

    def save(ctx: Any, inputs: tuple[Any, ...], output: Tensors) -> None:
        _save(ctx, operator, inputs, output)

    def pull(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        weights = operator.select_differentiable(operator.outputs, upstream)
        return _spread(operator, backward(*ctx.saved_tensors, *weights, ctx.options))

    forward.register_autograd(pull, setup_context=save)

    @forward.register_vmap
    def _(info: Any, axes: tuple[int | None, ...], *given: Any) -> Any:
        def call(*x: Tensor) -> Tensors:
            found: Tensors = forward(*x, given[-1])
            return found

        return _map(operator, call, info.batch_size, axes[:-1], given[:-1], operator.inputs, operator.outputs)

    @backward.register_vmap
    def _(info: Any, axes: tuple[int | None, ...], *given: Any) -> Any:
        def call(*x: Tensor) -> Tensors:
            return tuple(backward(*x, given[-1]))

        found, out_axes = _map(operator, call, info.batch_size, axes[:-1], given[:-1], operator.pulled, operator.leaves)
        return list(found), list(out_axes)


class _Outputs(torch.autograd.Function):
    """Outputs of an operator outside of graphs: `torch.library` does not support forward mode."""

    @staticmethod
    def forward(operator: Operator, *given: Any) -> Tensors:
        return operator.evaluate(given[:-1], given[-1])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensors) -> None:
        ctx.operator = inputs[0]
        _save(ctx, ctx.operator, inputs[1:], output)
        fixed = [
            x for name, x in zip(ctx.operator.outputs, output, strict=True) if name not in ctx.operator.differentiable
        ]
        ctx.mark_non_differentiable(*fixed)
        ctx.save_for_forward(*inputs[1:-1], *output)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        weights = ctx.operator.select_differentiable(ctx.operator.outputs, upstream)
        found = _Gradients.apply(ctx.operator, *ctx.saved_tensors, *weights, ctx.options)
        return (None, *_spread(ctx.operator, found))

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> tuple[Tensor | None, ...]:
        operator, saved = ctx.operator, ctx.saved_tensors
        primals = operator.select_differentiable(operator.inputs, saved[: len(operator.inputs)])
        given = operator.select_differentiable(operator.inputs, tangents[1:-1])
        filled = [torch.zeros_like(x) if t is None else t for x, t in zip(primals, given, strict=True)]
        found = iter(_Tangents.apply(operator, *saved, *filled, ctx.options))
        return tuple(next(found) if name in operator.differentiable else None for name in operator.outputs)

    @staticmethod
    def vmap(info: Any, axes: tuple[int | None, ...], operator: Operator, *given: Any) -> Any:
        def call(*x: Tensor) -> Tensors:
            found: Tensors = _Outputs.apply(operator, *x, given[-1])
            return found

        return _map(operator, call, info.batch_size, axes[1:-1], given[:-1], operator.inputs, operator.outputs)


class _Linear(torch.autograd.Function):
    """Product of a derivative and a vector; second derivatives are not supported."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensors) -> None:
        ctx.name = inputs[0].name

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> None:
        raise NotImplementedError(f"second derivatives of {NAMESPACE}::{ctx.name}")


class _Gradients(_Linear):
    @staticmethod
    def forward(operator: Operator, *given: Any) -> Tensors:
        return _gradients(operator, *given)

    @staticmethod
    def vmap(info: Any, axes: tuple[int | None, ...], operator: Operator, *given: Any) -> Any:
        def call(*x: Tensor) -> Tensors:
            found: Tensors = _Gradients.apply(operator, *x, given[-1])
            return found

        return _map(operator, call, info.batch_size, axes[1:-1], given[:-1], operator.pulled, operator.leaves)


class _Tangents(_Linear):
    @staticmethod
    def forward(operator: Operator, *given: Any) -> Tensors:
        inputs, outputs, tangents = _split(operator, given[:-1])
        return operator.tangents(inputs, outputs, tangents, given[-1])

    @staticmethod
    def vmap(info: Any, axes: tuple[int | None, ...], operator: Operator, *given: Any) -> Any:
        def call(*x: Tensor) -> Tensors:
            found: Tensors = _Tangents.apply(operator, *x, given[-1])
            return found

        return _map(operator, call, info.batch_size, axes[1:-1], given[:-1], operator.pushed, operator.outputs)


def _gradients(operator: Operator, *given: Any) -> Tensors:
    inputs, outputs, upstream = _split(operator, given[:-1])
    return operator.gradients(inputs, outputs, upstream, given[-1])


def _call_with_autograd(work: Callable[[], Tensors]) -> Tensors:
    """Call with autograd recording: PyTorch turns it off inside operators, but only in the current thread."""
    with torch.enable_grad():
        records = (torch.zeros((), requires_grad=True) + 0).requires_grad
    if records:
        return work()
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(work).result()


def _split(operator: Operator, given: Tensors) -> tuple[Tensors, Tensors, Tensors]:
    """Split the arguments into inputs, outputs and the rest."""
    first, second = len(operator.inputs), len(operator.inputs) + len(operator.outputs)
    return given[:first], given[first:second], given[second:]


def _save(ctx: Any, operator: Operator, inputs: tuple[Any, ...], output: Tensors) -> None:
    ctx.options = inputs[-1]
    ctx.save_for_backward(*inputs[:-1], *output)


def _spread(operator: Operator, gradients: Iterable[Tensor]) -> tuple[Tensor | None, ...]:
    """Gradients of all inputs and the options; None where an input has no derivative."""
    found = iter(gradients)
    return (*(next(found) if name in operator.differentiable else None for name in operator.inputs), None)


def _map(
    operator: Operator,
    call: Callable[..., Tensors],
    size: int,
    axes: Sequence[int | None],
    given: Tensors,
    names: Sequence[str],
    returned: Sequence[str],
) -> tuple[Tensors, tuple[int, ...]]:
    """Call with one more axis: once with a longer batch if everything mapped has a batch, else once per entry."""
    batched = [name in operator.batched for name in names]
    if operator.batched.issuperset(returned) and all(
        axis is None or has for axis, has in zip(axes, batched, strict=True)
    ):
        folded = (_fold(x, axis, size) if has else x for x, axis, has in zip(given, axes, batched, strict=True))
        found = call(*folded)
        return tuple(x.unflatten(0, (size, len(x) // size)) for x in found), (0,) * len(found)
    rows = [
        call(*(x if axis is None else x.select(axis, i) for x, axis in zip(given, axes, strict=True)))
        for i in range(size)
    ]
    return tuple(torch.stack(column) for column in zip(*rows, strict=True)), (0,) * len(rows[0])


def _fold(x: Tensor, axis: int | None, size: int) -> Tensor:
    moved = x.expand(size, *x.shape) if axis is None else x.movedim(axis, 0)
    return moved.flatten(0, 1)
