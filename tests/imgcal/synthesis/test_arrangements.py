import math

import pytest
import torch

from imgcal.errors import InputError
from imgcal.synthesis import Lens, arrange_positions, arrange_rig, look_at


@pytest.mark.parametrize("shape", ["ring", "dome", "row"])
@pytest.mark.parametrize("cameras", [1, 2, 7])
def test_every_camera_has_the_target_in_the_middle_of_its_image(shape, cameras):
    target = (100.0, -50.0, 700.0)
    rig = arrange_rig(shape, cameras, 3000.0, height=2000.0, target=target, lens=Lens((641, 481), 60.0))
    projection = rig.project(torch.tensor([target, (100.0, -50.0, 800.0)], dtype=torch.float64))
    torch.testing.assert_close(projection.uv[:, 0], torch.tensor([[320.0, 240.0]] * cameras, dtype=torch.float64))
    assert projection.visible[:, 0].all()
    # What is above the target is above it in the image, unless the camera looks straight down.
    level = rig.positions[:, :2].sub(torch.tensor(target[:2], dtype=torch.float64)).norm(dim=-1) > 1
    assert (projection.uv[level, 1, 1] < 240).all()
    assert torch.det(rig.cam_from_rig.rotation).allclose(torch.ones(cameras, dtype=torch.float64))


def test_a_camera_straight_above_has_some_way_up():
    found = look_at(torch.tensor([[0.0, 0.0, 1000.0]]), torch.zeros(3))
    assert found.rotation.isfinite().all() and torch.allclose(found.rotation @ found.rotation.mT, torch.eye(3))


def test_a_dome_is_even_and_above_the_ground():
    positions = arrange_positions("dome", 40, 1000.0, 0.0)
    assert (positions[:, 2] > 0).all()
    torch.testing.assert_close(positions.norm(dim=-1), torch.full((40,), 1000.0, dtype=torch.float64))
    apart = torch.cdist(positions, positions).fill_diagonal_(torch.inf).amin(1)
    assert apart.min() > 0.6 * apart.max()


def test_impossible_arrangements():
    with pytest.raises(InputError, match="cameras: found 0"):
        arrange_rig("ring", 0, 1000.0)
    with pytest.raises(InputError, match="radius"):
        arrange_rig("ring", 3, -1.0)
    for value in (math.inf, -math.inf, math.nan, 1e300):
        with pytest.raises(InputError, match=r"height: found .*, expected -1e\+06 to 1e\+06 mm"):
            arrange_rig("ring", 3, 1000.0, height=value)
        with pytest.raises(InputError, match=r"target: found 0 .* 0, expected"):
            arrange_rig("ring", 3, 1000.0, target=(0.0, value, 0.0))
    with pytest.raises(InputError, match="very point"):
        arrange_rig("row", 3, 1000.0, target=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="field_of_view_deg"):
        Lens(field_of_view_deg=180.0)
