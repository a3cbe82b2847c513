"""Code knows whether it is followed."""

import warnings

import torch

from renderers import is_traced


def test_plain_code_is_not_traced():
    assert not is_traced()
    with torch.no_grad():
        assert not is_traced()


def test_transforms_and_graphs_are():
    found = []

    def ask(x):
        found.append(is_traced())
        return x * (2 if is_traced() else 1)

    torch.func.vmap(ask)(torch.zeros(2))
    torch.func.grad(lambda x: ask(x).sum())(torch.zeros(2))
    torch.func.jacfwd(ask)(torch.zeros(2))
    assert found == [True] * 3
    with warnings.catch_warnings(action="ignore", category=Warning):
        torch.jit.trace(ask, torch.ones(2), check_trace=False)
    assert found[3:] and all(found[3:])
    compiled = torch.compile(lambda x: x * (2 if is_traced() else 1), fullgraph=True, backend="eager")
    assert torch.equal(compiled(torch.ones(2)), torch.full((2,), 2.0))
