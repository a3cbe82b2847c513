import math
from dataclasses import replace

import pytest
import torch

from imgcal.io import load_object, read_rig
from imgcal.synthesis import DIFFICULTIES, Difficulty, FrameModel, PhysicalDrift, simulate_shots, simulate_truth
from renderers import SensorModel, Spots


@pytest.fixture(scope="module")
def small():
    rig, obj = read_rig("T4"), load_object("asymmetric8")
    scale = 0.25
    rig = replace(
        rig.select([0, 1]),
        focal_length=rig.focal_length[:2] * scale,
        principal_point=(rig.principal_point[:2] + 0.5) * scale - 0.5,
        image_size=(rig.image_size[:2] * scale).to(rig.image_size.dtype),
    )
    return simulate_truth(rig, obj, 2, torch.Generator().manual_seed(0), PhysicalDrift()), obj


@pytest.mark.parametrize("name", DIFFICULTIES)
def test_every_level_makes_frames(small, name):
    truth, obj = small
    shots = list(
        simulate_shots(truth, obj, FrameModel(difficulty=DIFFICULTIES[name]), torch.Generator().manual_seed(1))
    )
    again = next(
        simulate_shots(truth, obj, FrameModel(difficulty=DIFFICULTIES[name]), torch.Generator().manual_seed(1))
    )
    assert len(shots) == 2
    for camera, frame in shots[0].frames.items():
        assert frame.shape == tuple(truth.rig.image_size[0].tolist()[::-1])
        assert (frame == again.frames[camera]).all()
        assert (frame != shots[1].frames[camera]).any()
    seen = torch.stack([shot.seen for shot in shots])
    assert seen.shape == (2, 2, 8)
    assert seen.min() >= 0
    assert seen.max() < 1.001
    assert (seen > 0.9).any()


def test_the_path_is_that_of_the_moving_object(small):
    """Two poses at the ends of the exposure: their images are as far apart as the path is long."""
    truth, obj = small
    level = Difficulty(exposure_ms=(20.0, 20.0), speed=(500.0, 500.0))
    smear = level.smear(truth.rig, truth.rig_from_object[0], obj.points, None, torch.Generator().manual_seed(0))
    assert smear.path.shape == (2, 8, 2)
    assert smear.defocus.abs().max() == 0
    # 10 mm at some 850 mm; the direction is one of space, the same for all markers.
    lengths = smear.path.norm(dim=-1) / (truth.rig.focal_length[0, 0] * 10 / 850)
    assert lengths.max() < 1.3
    turning = Difficulty(exposure_ms=(20.0, 20.0), turn_deg=(90.0, 90.0))
    spin = turning.smear(truth.rig, truth.rig_from_object[0], obj.points, None, torch.Generator().manual_seed(0)).path
    radius = (obj.points - obj.points.mean(0)).norm(dim=-1).max()
    most = radius * math.radians(90) * 0.02 * truth.rig.focal_length.max() / 600
    assert 0 < spin.norm(dim=-1).max() < most


def test_disguises_are_as_frequent_as_they_say():
    one = torch.ones(50, 40, dtype=torch.float64)
    markers = Spots(torch.zeros(50, 40, 2).double(), 36 * torch.eye(2).double().expand(50, 40, 2, 2), one, one > 0, one)
    level = Difficulty(hidden=0.3, cut=0.5, cut_diameter=(0.5, 0.5))
    changed = level.disguise(markers, torch.Generator().manual_seed(0))
    assert changed.visible.double().mean().item() == pytest.approx(0.7, abs=0.03)
    offset = changed.surface.cuts[..., 0, 2]
    assert offset.isfinite().double().mean().item() == pytest.approx(0.5, abs=0.04)
    assert offset[offset.isfinite()].abs().max() < 1e-9  # half of the diameter: through the centre
    assert Difficulty().disguise(markers, torch.Generator().manual_seed(0)).surface is None


def test_low_light_keeps_bit_depth_and_polarity():
    bright = SensorModel(bit_depth=12, polarity="dark", blur=1.1)
    dim = Difficulty(peak_snr=(2.0, 2.0), row_noise=1.0).sensor(bright, torch.Generator().manual_seed(0))
    assert (dim.bit_depth, dim.polarity, dim.blur, dim.row_noise) == (12, "dark", 1.1, 1.0)
    assert dim.contrast < 0.01
    assert Difficulty().sensor(bright, torch.Generator()) == bright


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"cut": 2.0}, "cut must be a share"),
        ({"speed": (5.0, 1.0)}, "speed must be an interval"),
        ({"peak_snr": (0.0, 1.0)}, "peak_snr must be an interval"),
        ({"bumps": 50}, "bumps, row_noise must be"),
    ],
)
def test_impossible_levels_are_named(values, expected):
    with pytest.raises(ValueError, match=expected):
        Difficulty(**values)
