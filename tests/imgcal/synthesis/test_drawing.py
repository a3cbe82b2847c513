import torch

from imgcal.synthesis import host_generator
from imgcal.synthesis.drawing import Draw


def test_numbers_are_what_they_say() -> None:
    draw = Draw(torch.Generator().manual_seed(0))
    values = draw.between(-2.0, 3.0, 4000)
    assert -2 <= float(values.min()) < -1.9
    assert 2.9 < float(values.max()) < 3
    some = draw.sometimes(0.25, 4.0, 4000)
    assert 0.2 < float((some > 0).float().mean()) < 0.3
    assert float(some.max()) < 4
    torch.testing.assert_close(draw.direction(10, of=2).norm(dim=-1), torch.ones(10))


def test_host_numbers_follow_the_generator() -> None:
    generator = torch.Generator().manual_seed(0)
    first = torch.rand(3, generator=host_generator(generator))
    assert torch.equal(first, torch.rand(3, generator=host_generator(generator)))  # looking takes nothing from it
    torch.rand(1, generator=generator)
    assert not torch.equal(first, torch.rand(3, generator=host_generator(generator)))
