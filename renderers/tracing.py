"""Detect whether PyTorch runs code eagerly, or traces or transforms it."""

from collections.abc import Callable

import torch

# If PyTorch cannot tell whether code runs under `torch.func`, assume that it does: correct, but somewhat slower.
_is_transformed: Callable[[], bool] = getattr(torch._C, "_are_functorch_transforms_active", lambda: True)


def is_traced() -> bool:
    """Tell whether `torch.compile`, `torch.export`, `torch.jit.trace` or a transform of `torch.func` is active.

    Tensors then hold no values, or only part of them, and compiled loops cannot read them.
    """
    return torch.compiler.is_compiling() or torch.jit.is_tracing() or _is_transformed()
