"""Layers that draw from a given generator."""

import pytest
import torch

from imgcal.networks import use_generators


def test_layers_draw_from_a_generator_that_goes_on():
    layer, generator = torch.nn.Dropout(0.5), torch.Generator().manual_seed(3)
    with use_generators(generator):
        first = layer(torch.ones(100))
    with pytest.raises(ZeroDivisionError), use_generators(generator):
        raise ZeroDivisionError
    with use_generators(generator):
        second = layer(torch.ones(100))
    torch.manual_seed(3)
    assert torch.equal(torch.cat((first, second)), torch.cat((layer(torch.ones(100)), layer(torch.ones(100)))))
