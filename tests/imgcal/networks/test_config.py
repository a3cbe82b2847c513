"""Presets, and the values that may be changed in them."""

import pytest
import torch

from imgcal.networks import PRESETS, NetworkConfig
from imgcal.training.losses import project_fiducials
from tests.imgcal.networks.making import make, snapshots, views


def millions(network):
    return sum(parameter.numel() for parameter in network.parameters()) / 1e6


@pytest.mark.parametrize(
    ("preset", "expected"), [("paper-points", 33), ("paper-cnn1d", 8), ("paper-vit", 86), ("paper-cnn2d", 24)]
)
def test_presets_of_the_paper_have_its_size(preset, expected):
    assert millions(make(preset, "O10", "cube8")) == pytest.approx(expected, abs=0.5)


@pytest.mark.parametrize("preset", ["points", "vit", "cnn"])
def test_presets_that_ship_are_small(preset):
    assert 1 < millions(make(preset, "O10")) < 2.9


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"preset": "pointz"}, "nearest: points"),
        ({"preset": "points", "change": {"trunk": {"widht": 3}}}, "nearest: width"),
        ({"preset": "points", "change": {"trunk": {"passes": 0}}}, "greater than or equal to 1"),
        ({"preset": "points", "change": {"trunk": {"width": 130}}}, "found width 130 and 4 heads"),
        ({"preset": "paper-points", "change": {"heads": 3}}, "found width 512 and 3 heads"),
        ({"preset": "paper-vit", "change": {"head_widths": [0]}}, "greater than or equal to 1"),
    ],
)
def test_impossible_configurations_are_refused(config, message):
    with pytest.raises(ValueError, match=message):
        NetworkConfig(**config)


@pytest.mark.parametrize(
    "change", [{"width": 4096, "depth": 64}, {"depth": 10**7}, {"width": 10**6}, {"passes": 10**6}]
)
def test_a_network_that_fits_in_no_memory_is_refused_before_it_is_built(change):
    with pytest.raises(ValueError, match=r"fits in memory|less than or equal"):
        NetworkConfig(preset="points", change={"trunk": change})


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_changes_in_what_is_named_and_predicts_rigs(preset):
    small_image = {"vit": {"depth": 1}, "cnn": {"depths": [1, 1, 1, 1], "dims": [8, 8, 16, 16]}}
    change = {
        "paper-points": {"width": 32, "depth": 1},
        "paper-cnn1d": {"width": 32, "depth": 1},
        "paper-vit": {"backbone": "vit_tiny_patch16_224", "options": small_image["vit"], "bottleneck": 16},
        "paper-cnn2d": {"backbone": "convnext_atto", "options": small_image["cnn"], "bottleneck": 16},
    }.get(preset, {"trunk": {"width": 32, "depth": 1}})
    before, after = PRESETS[preset].model_dump(), NetworkConfig(preset=preset, change=change).variant().model_dump()
    wanted = {**change, "trunk": {**before["trunk"], **change["trunk"]}} if "trunk" in change else change
    assert after == before | wanted
    assert PRESETS[preset].model_dump() == before
    network = make(preset, **change)
    given = views(network, snapshots(network))
    for prediction in network(given):
        cameras = prediction.cameras_from_object
        assert cameras.focal_length.shape == (3, 4, 2) and cameras.cam_from_rig.translation.shape == (3, 4, 3)
        assert torch.isfinite(project_fiducials(cameras, network.obj)).all()
