"""Addition of splats on CPUs as a PyTorch operator: for eager code, `torch.func`, `torch.compile` and export.

Eager code keeps what the gradient needs besides the images. It has derivatives in both directions, of any order, under
any number of nested `torch.func.vmap`. A graph sees one opaque operator, which computes the windows again in its
backward pass: a graph cannot hold tensors whose size depends on values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from renderers import additive_splatting, additive_splatting_cpu
from renderers.additive_splatting import Splats
from renderers.tracing import is_traced

SPLATS = "Tensor uv, Tensor sizes, Tensor weight, Tensor colours, Tensor visible"

Function = Callable[..., Any]


def splat_additively(splats: Splats, image_size: tuple[int, int], out: Tensor | None = None) -> Tensor:
    """Draw like `additive_splatting.splat_additively`, with the same arguments, for tensors on the CPU."""
    if torch.compiler.is_compiling():
        images: Tensor = add_splats(*splats, *image_size)
        return images if out is None else out.copy_(images)
    if out is not None:
        additive_splatting_cpu.draw(out, splats)
        return out
    if is_traced():
        return _Added.apply(*splats, *image_size)[0]
    images = _AddedPlainly.apply(*splats, *image_size)
    return images


class _Added(torch.autograd.Function):
    """Images, and the windows for their gradient."""

    @staticmethod
    def forward(*inputs: Any) -> tuple[Tensor, ...]:
        return additive_splatting_cpu.draw_new(Splats(*inputs[:5]), inputs[5:])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.image_size = inputs[5:]
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*inputs[:5], *output[1:])
        ctx.save_for_forward(*inputs[:5])

    @staticmethod
    def backward(ctx: Any, upstream: Tensor | None, *_: Any) -> tuple[Tensor | None, ...]:
        if upstream is None:
            return (None,) * 7
        return (*_Gradients.apply(upstream, *ctx.saved_tensors), None, None, None)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> tuple[Tensor | None, ...]:
        *values, visible = ctx.saved_tensors
        return _tangent(_images_by(visible, ctx.image_size), values, tangents[:4]), None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        folded = _fold(info.batch_size, in_dims[:5], inputs[:5])
        return _unfold(info.batch_size, _Added.apply(*folded, *inputs[5:]))


class _AddedPlainly(torch.autograd.Function):
    """The same as `_Added` for use outside of `torch.func`, where PyTorch calls this form faster."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        output = _Added.forward(*inputs)
        ctx.image_size = inputs[5:]
        ctx.save_for_backward(*inputs[:5], *output[1:])
        ctx.save_for_forward(*inputs[:5])
        return output[0]

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # the gradient itself is to be differentiated
            return _Added.backward(ctx, upstream)
        return (*_Gradients.forward(upstream, *ctx.saved_tensors), None, None, None)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor | None:
        return _Added.jvp(ctx, *tangents)[0]


class _Gradients(torch.autograd.Function):
    """Gradients of images with respect to all inputs but `visible`."""

    @staticmethod
    def forward(*inputs: Tensor) -> tuple[Tensor, ...]:
        return additive_splatting_cpu.gradients(inputs[0], Splats(*inputs[1:6]), *inputs[6:])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
        ctx.save_for_backward(*inputs[:6])
        ctx.save_for_forward(*inputs[:6])

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        return (*_second_gradients(upstream, *ctx.saved_tensors), None, None, None)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> tuple[Tensor, ...]:
        *values, visible = ctx.saved_tensors
        return _tangent(_gradients_by(visible), values, tangents[:5])

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Tensor) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        folded = _fold(info.batch_size, in_dims, inputs)
        return _unfold(info.batch_size, _Gradients.apply(*folded))


@torch.library.custom_op(
    "renderers::add_splats",
    mutates_args=(),
    device_types="cpu",
    schema=f"({SPLATS}, SymInt height, SymInt width) -> Tensor",
)
def add_splats(
    uv: Tensor, sizes: Tensor, weight: Tensor, colours: Tensor, visible: Tensor, height: int, width: int
) -> Tensor:
    """Draw splats: (B, K, height, width), see `additive_splatting.splat_additively`."""
    return additive_splatting_cpu.draw_new(Splats(uv, sizes, weight, colours, visible), (height, width))[0]


@torch.library.custom_op(
    "renderers::add_splats_gradients",
    mutates_args=(),
    device_types="cpu",
    schema=f"(Tensor upstream, {SPLATS}) -> (Tensor, Tensor, Tensor, Tensor)",
)
def add_splats_gradients(
    upstream: Tensor, uv: Tensor, sizes: Tensor, weight: Tensor, colours: Tensor, visible: Tensor
) -> tuple[Tensor, ...]:
    """Pull the gradient of the images back to all inputs but `visible`."""
    splats = Splats(uv, sizes, weight, colours, visible)
    windows = additive_splatting_cpu.windows(splats, max(upstream.shape[2:]))
    return additive_splatting_cpu.gradients(upstream, splats, *windows)


@add_splats.register_fake
def _(uv: Tensor, sizes: Tensor, weight: Tensor, colours: Tensor, visible: Tensor, height: int, width: int) -> Tensor:
    return uv.new_empty(uv.shape[0], colours.shape[2], height, width)


@add_splats_gradients.register_fake
def _(upstream: Tensor, *splats: Tensor) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(x, memory_format=torch.contiguous_format) for x in splats[:4])


def _save(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    ctx.save_for_backward(*(x for x in inputs if isinstance(x, Tensor)))


def _add_splats_backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
    return (*add_splats_gradients(upstream, *ctx.saved_tensors), None, None, None)


def _add_splats_gradients_backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
    return (*_second_gradients(upstream, *ctx.saved_tensors), None)


add_splats.register_autograd(_add_splats_backward, setup_context=_save)
add_splats_gradients.register_autograd(_add_splats_gradients_backward, setup_context=_save)


@add_splats.register_vmap
def _(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> tuple[Tensor, int]:
    folded = _fold(info.batch_size, in_dims[:5], inputs[:5])
    return add_splats(*folded, *inputs[5:]).unflatten(0, (info.batch_size, -1)), 0


@add_splats_gradients.register_vmap
def _(info: Any, in_dims: tuple[int | None, ...], *inputs: Tensor) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    return _unfold(info.batch_size, add_splats_gradients(*_fold(info.batch_size, in_dims, inputs)))


def _images_by(visible: Tensor, image_size: tuple[int, int]) -> Function:
    """Return a function from tensors to images."""

    def images(uv: Tensor, sizes: Tensor, weight: Tensor, colours: Tensor) -> Tensor:
        return additive_splatting.splat_additively(Splats(uv, sizes, weight, colours, visible), image_size)

    return images


def _gradients_by(visible: Tensor) -> Function:
    """Return a function from tensors to gradients; its first argument is the gradient of the images."""

    def gradients(upstream: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        pull: Function = torch.func.vjp(_images_by(visible, (upstream.shape[2], upstream.shape[3])), *values)[1]
        return pull(upstream)

    return gradients


def _second_gradients(upstream: Sequence[Tensor], *inputs: Tensor) -> tuple[Tensor, ...]:
    *values, visible = inputs
    pull: Function = torch.func.vjp(_gradients_by(visible), *values)[1]
    return pull(tuple(upstream))


def _tangent(function: Function, primals: Sequence[Tensor], tangents: Sequence[Tensor | None]) -> Any:
    """Push tangents forward by pulling back twice: pulling back is linear, and its transpose pushes forward."""
    value, pull = torch.func.vjp(function, *primals)[:2]
    zero = torch.zeros_like(value) if isinstance(value, Tensor) else tuple(map(torch.zeros_like, value))
    push: Function = torch.func.vjp(pull, zero)[1]
    filled = (torch.zeros_like(x) if t is None else t for x, t in zip(primals, tangents, strict=True))
    return push(tuple(filled))[0]


def _fold(size: int, in_dims: Sequence[int | None], tensors: Sequence[Tensor]) -> list[Tensor]:
    """Fold the mapped axis into the first: (B, ...) each."""
    moved = (
        x.expand(size, *x.shape) if axis is None else x.movedim(axis, 0)
        for x, axis in zip(tensors, in_dims, strict=True)
    )
    return [x.flatten(0, 1) for x in moved]


def _unfold(size: int, tensors: Sequence[Tensor]) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    return tuple(x.unflatten(0, (size, len(x) // max(size, 1))) for x in tensors), (0,) * len(tensors)
