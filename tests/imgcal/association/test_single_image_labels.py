from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import is_small_planar, label_by_shape
from imgcal.io import load_object, read_rig
from imgcal.synthesis import simulate_volume


@pytest.fixture(scope="module")
def scene():
    camera, wand = read_rig("room10").select([1]), load_object("wand4")
    truth = simulate_volume(camera, wand, 80, torch.Generator().manual_seed(2), None, volume=read_rig("room10").volume)
    whole = truth.visible[:, 0].all(-1)
    return camera, wand, truth.uv[whole, 0].numpy()


def shuffled(uv, rng, false=0):
    """Images of blobs in random order, some of them false: with the fiducial of each, -1 = none."""
    images, labels = [], []
    for markers in uv:
        blobs = np.concatenate((markers + 0.05 * rng.normal(size=markers.shape), rng.random((false, 2)) * [1279, 1023]))
        order = rng.permutation(len(blobs))
        images.append(blobs[order])
        labels.append(np.where(order < len(markers), order, -1))
    return images, labels


@pytest.mark.parametrize(("factor", "false", "least"), [(1.0, 0, 0.85), (1.15, 0, 0.85), (0.87, 4, 0.4)])
def test_most_images_of_a_wand_say_which_blob_is_which(scene, factor, false, least):
    camera, wand, uv = scene
    rough = replace(camera, focal_length=factor * camera.focal_length, distortion=torch.zeros_like(camera.distortion))
    images, labels = shuffled(uv, np.random.default_rng(0), false)
    found = label_by_shape(images, rough, wand)
    right = [mine is not None and np.array_equal(mine, truth) for mine, truth in zip(found, labels, strict=True)]
    wrong = [mine is not None and not good for mine, good in zip(found, right, strict=True)]
    assert np.mean(right) > least and np.mean(wrong) < 0.03


def test_blobs_of_another_size_are_no_rivals(scene):
    camera, wand, uv = scene
    images, labels = shuffled(uv, np.random.default_rng(1), 6)
    radii = [np.where(label >= 0, 3.0, 6.0) for label in labels]
    found = label_by_shape(images, camera, wand, radii)
    assert np.mean([mine is not None and np.array_equal(mine, t) for mine, t in zip(found, labels, strict=True)]) > 0.85


def test_what_is_no_wand_is_not_labelled(scene):
    camera, wand, _ = scene
    rng = np.random.default_rng(3)
    images = [rng.random((4, 2)) * 1000 for _ in range(50)] + [np.zeros((0, 2)), np.zeros((3, 2)), np.zeros((40, 2))]
    assert sum(labels is not None for labels in label_by_shape(images, camera, wand)) <= 1
    assert is_small_planar(wand) and not is_small_planar(load_object("cube8"))
