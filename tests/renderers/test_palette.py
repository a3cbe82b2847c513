"""The palette against scikit-image's colour differences."""

import math

import numpy as np
import pytest
import torch
from skimage.color import deltaE_ciede2000, rgb2lab

from renderers import palette

# Least CIEDE2000 difference of any two colours; 1 is just noticeable.
LIMITS = {8: 22.0, 27: 9.0, 64: 5.0, 437: 2.0}


@pytest.mark.parametrize("count", LIMITS)
def test_colours_differ_from_each_other_and_from_black(count: int) -> None:
    colours = palette(count)
    assert colours.shape == (count, 3)
    assert colours.dtype == torch.float32
    assert colours.min() >= 0
    assert colours.max() <= 1
    assert colours.amax(dim=1).min() >= 0.69
    lab = rgb2lab(colours.double().numpy()[None])[0]
    first, second = np.triu_indices(count, 1)
    assert deltaE_ciede2000(lab[first], lab[second]).min() >= LIMITS[count]
    assert deltaE_ciede2000(lab, np.zeros_like(lab)).min() >= 33


def test_eight_colours_stay_apart_where_a_splat_fades() -> None:
    directions = torch.nn.functional.normalize(palette(8), dim=1)
    cosines = (directions @ directions.T).fill_diagonal_(0)
    assert cosines.max() < math.cos(math.radians(18))


def test_shorter_palettes_are_prefixes_of_longer_ones() -> None:
    longest = palette(437)
    for count in (0, 1, 8, 64):
        assert torch.equal(palette(count), longest[:count])


@pytest.mark.parametrize("count", [-1, 100_000])
def test_impossible_counts_are_refused(count: int) -> None:
    with pytest.raises(ValueError, match="count between 0 and"):
        palette(count)
