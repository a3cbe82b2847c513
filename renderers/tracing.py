"""Whether code is run, or followed by PyTorch to be run later or transformed."""

from collections.abc import Callable

import torch

# Where PyTorch does not say whether code runs under `torch.func`, it is taken to: right, and somewhat slower.
_is_transformed: Callable[[], bool] = getattr(torch._C, "_are_functorch_transforms_active", lambda: True)


def is_traced() -> bool:
    """Tell whether `torch.compile`, `torch.export`, `torch.jit.trace` or a transform of `torch.func` follows: tensors
    hold no values then, or not the whole of them, and compiled loops cannot read them.
    """
    return torch.compiler.is_compiling() or torch.jit.is_tracing() or _is_transformed()
