from dataclasses import replace

import pytest
import torch

from imgcal.io import read_rig
from imgcal.live_page.rig_drawing import viewing_volume
from imgcal.types import ConvexVolume
from tests.imgcal.live_page.pages import dome


@pytest.mark.parametrize("name", ["O10", "O6", "U7", "T4", "room10"])
def test_most_cameras_see_the_middle_of_the_volume(name):
    rig = read_rig(name)
    volume = viewing_volume(rig)
    middle = (volume.low + volume.high)[None] / 2
    assert rig.project(middle).visible.float().mean() >= 0.6
    assert (volume.high > volume.low).all()
    share = rig.project(volume.grid(7).flatten(0, -2)).visible.sum(0)
    assert (share >= 2).float().mean() > 0.5


def test_a_rig_that_names_its_volume_has_it(o10):
    volume = viewing_volume(replace(o10, volume=ConvexVolume.box((-1, -2, 700), (1, 2, 800))))
    assert volume.low.tolist() == [-1, -2, 700] and volume.high.tolist() == [1, 2, 800]


def test_a_dome_looks_at_its_middle_and_one_camera_ahead():
    volume = viewing_volume(dome(64))
    assert volume.contains(torch.tensor([0.0, 0.0, 0.0]).double())
    one = read_rig("O10").select([0])
    middle = (viewing_volume(one).low + viewing_volume(one).high) / 2
    assert one.project(middle[None]).visible.all()
