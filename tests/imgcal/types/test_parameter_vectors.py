import pytest
import torch

from imgcal.synthesis import PhysicalDrift, PoseRange
from imgcal.synthesis.rigs import sample_rig_from_object
from imgcal.types import CameraRig, pack21, unpack18, unpack21
from imgcal.types.parameter_vectors import pack18
from tests.imgcal.types.same_rig import assert_same


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (10,)])  # the last one has as many rigs as cameras
def test_packings_round_trip(o10: CameraRig, batch: tuple[int, ...]) -> None:
    generator, centroid = torch.Generator().manual_seed(0), torch.zeros(3, dtype=torch.float64)
    pose = sample_rig_from_object(torch.Size(batch).numel(), 850.0, centroid, PoseRange(), generator).reshape(*batch)
    rig = PhysicalDrift(rotation_deg=3).apply(o10, generator, *batch).from_object(pose)
    packed21, packed18 = pack21(rig), pack18(rig)
    assert packed21.shape == (*batch, 10, 21)
    assert packed18.shape == (*batch, 10, 18)
    assert_same(unpack21(packed21, o10), rig)
    assert_same(unpack18(packed18, o10), rig)


def test_packing_follows_the_paper(o10: CameraRig) -> None:
    packed = pack21(o10)[3]
    torch.testing.assert_close(packed[:9], o10.cam_from_rig.rotation[3].reshape(9))
    torch.testing.assert_close(packed[9:12], o10.cam_from_rig.translation[3])
    torch.testing.assert_close(packed[12:14], o10.focal_length[3])
    torch.testing.assert_close(packed[14:16], o10.principal_point[3])
    torch.testing.assert_close(packed[16:], o10.distortion[3])
