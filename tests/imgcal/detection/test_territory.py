"""Distances and territories of blobs against SciPy's distance transform."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.ndimage import label as components

from imgcal.detection.candidates import BLOCK
from imgcal.detection.territory import MARGIN, SKIRT, SPREAD, claim, spread_labels

SHAPE = (40, 48)  # pixels, whole blocks


def tiles_of(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels (H, W) as tiles: the number of each block's tile with an empty block around, and the tiles."""
    rows, columns = image.shape[0] // BLOCK, image.shape[1] // BLOCK
    blocks = image.reshape(rows, BLOCK, columns, BLOCK).swapaxes(1, 2)
    tile = np.zeros((rows + 2, columns + 2), np.int32)
    used = np.argwhere(blocks.any((2, 3)))
    labels = np.zeros((len(used) + 1, BLOCK, BLOCK), np.int32)
    for number, (r, c) in enumerate(used, start=1):
        tile[r + 1, c + 1], labels[number] = number, blocks[r, c]
    return tile, labels


def image_of(seed: int) -> np.ndarray:
    """Discs here and there, numbered where they are connected."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    marked = np.zeros(SHAPE, bool)
    for row, column in random.uniform((6, 6), (34, 42), (5, 2)):
        marked |= (v - row) ** 2 + (u - column) ** 2 <= random.uniform(1.5, 3.0) ** 2
    return components(marked, np.ones((3, 3)))[0].astype(np.int32)


def spread(image: np.ndarray, name: int, first=(-8, -8), side=(56, 64)):
    own, other, scratch = (np.empty(side, np.uint8) for _ in range(3))
    crowded = spread_labels(*tiles_of(image), np.array(first), name, scratch, own, other)
    return own, other, crowded


def around(image: np.ndarray, first=(-8, -8), side=(56, 64)) -> np.ndarray:
    """The window's part of the image, empty beyond its border."""
    window = np.zeros(side, image.dtype)
    window[-first[0] : -first[0] + SHAPE[0], -first[1] : -first[1] + SHAPE[1]] = image
    return window


@pytest.mark.parametrize("seed", range(3))
def test_distances_are_exact_as_far_as_they_are_asked_for(seed: int) -> None:
    image = image_of(seed)
    window = around(image)
    inner = (slice(SPREAD, -SPREAD),) * 2
    for name in range(1, image.max() + 1):
        own, other, crowded = spread(image, name)
        assert crowded == (image.max() > 1)
        for found, mask in ((own, window == name), (other, (window > 0) & (window != name))):
            expected = distance_transform_edt(~mask) ** 2 if mask.any() else np.full(window.shape, np.inf)
            near = expected[inner] <= SPREAD**2
            np.testing.assert_array_equal(found[inner][near], np.rint(expected[inner][near]))
            assert (found[inner][~near] > SPREAD**2).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_territory_reaches_its_skirt_and_no_nearer_neighbour(seed: int) -> None:
    image = image_of(seed)
    window, smooth = around(image), np.random.default_rng(seed).random((56, 64)).astype(np.float32)
    inner = np.zeros(window.shape, bool)
    inner[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    for name in range(1, image.max() + 1):
        own, other, crowded = spread(image, name)
        territory = np.empty(window.shape, np.float32)
        saddle = claim(own, other, crowded, smooth, territory)
        to_own = distance_transform_edt(window != name)
        to_other = distance_transform_edt((window == 0) | (window == name))
        expected = inner & (to_own <= SKIRT) & (to_own <= to_other)
        np.testing.assert_array_equal(territory > 0, expected)
        border = expected & binary_dilation(to_other <= to_own, np.ones((3, 3)))
        assert saddle == smooth[border].max(initial=0)


def test_a_blob_alone_has_no_border_with_anything() -> None:
    image = np.zeros(SHAPE, np.int32)
    image[20:23, 20:23] = 1
    own, other, crowded = spread(image, 1)
    territory = np.empty(own.shape, np.float32)
    assert not crowded and claim(own, other, crowded, np.ones(own.shape, np.float32), territory) == 0
    assert territory.sum() == (distance_transform_edt(around(image) == 0) <= SKIRT).sum()
