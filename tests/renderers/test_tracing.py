import pytest
import torch

from renderers.tracing import is_traced


def test_code_that_is_run_is_not_traced() -> None:
    assert not is_traced()
    with torch.no_grad():
        assert not is_traced()
    torch.ones(2, requires_grad=True).sum().backward()
    assert not is_traced()


@pytest.mark.parametrize("transform", [torch.func.vmap, torch.func.grad, torch.func.jacfwd])
def test_transforms_are_seen_while_they_last(transform) -> None:
    seen = []

    def function(x: torch.Tensor) -> torch.Tensor:
        seen.append(is_traced())
        return (x * x).sum()

    transform(function)(torch.ones(3))
    assert seen == [True] and not is_traced()


def test_compiled_code_is_seen() -> None:
    def function(x: torch.Tensor) -> torch.Tensor:
        return x + 1 if is_traced() else x

    assert torch.compile(function, backend="eager")(torch.zeros(1)).item() == 1
    assert function(torch.zeros(1)).item() == 0
