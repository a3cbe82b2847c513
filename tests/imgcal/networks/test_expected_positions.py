import numpy as np
import torch

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.networks import Expectation, cut_crops, cut_patches
from imgcal.types import CropPlacement


def test_queries_stand_where_the_rig_projects() -> None:
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("cube8")
    poses = RigidTransform(
        torch.eye(3).double().expand(2, 3, 3), torch.tensor([[0.0, 0, 850], [30.0, 0, 850]]).double()
    )
    expected = Expectation.of(rig, obj, poses)
    assert expected.uv.shape == (2, 4, 8, 2)
    placement = expected.placement(rig, 96)
    queries = expected.queries(placement)
    assert queries.place.shape == (8, 8, 2)
    assert bool(queries.asked.all())
    back = placement.to_image(queries.place.double().unflatten(0, (2, 4)))
    torch.testing.assert_close(back, rig.expand(2).project(poses.apply(obj.points)).uv, atol=1e-3, rtol=0)
    shifted = expected.queries(placement, torch.full((2, 4, 2), 10.0).double())
    assert bool((shifted.place > queries.place).all())


def test_crops_are_block_means() -> None:
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 255, (100, 120), dtype=np.uint8)
    placement = CropPlacement(torch.tensor([[9.5, 19.5], [-4.5, 90.5], [0.0, 0.0]]), torch.tensor([4.0, 2.0, 1.0]), 12)
    crops = cut_crops({"a": frame, "b": frame, "c": None}, ("a", "b", "c"), placement)
    expected = frame[20:68, 10:58].reshape(12, 4, 12, 4).mean((1, 3))
    torch.testing.assert_close(crops[0], torch.from_numpy(expected).float())
    # The second one reaches over the left and lower border: no image is NaN.
    inside = torch.zeros(12, 12, dtype=torch.bool)
    inside[:4, 2:] = True
    assert torch.equal(crops[1].isfinite(), inside)
    assert not bool(crops[2].isfinite().any())
    assert torch.equal(cut_crops({"a": frame}, ("a", "b", "c"), placement, inverted=True)[0], -crops[0])


def test_patches_lie_around_their_places() -> None:
    rng = np.random.default_rng(1)
    frame = rng.integers(0, 255, (200, 160), dtype=np.uint8)
    uv = torch.tensor([[[80.3, 99.6], [3.0, 100.0]]] * 2)
    patches, placement = cut_patches({"a": frame}, ("a", "b"), uv, torch.tensor([[7.0, 7.2], [1.0, 1.0]]))
    assert placement.scale.tolist() == [[2, 2], [1, 1]]
    middle = placement.to_image(torch.full((2, 2, 1, 2), 11.5))[..., 0, :]
    assert float((middle - uv).abs().max()) <= 1
    left, top = (int(value) for value in placement.corner[0, 0] + 0.5)
    expected = frame[top : top + 48, left : left + 48].reshape(24, 2, 24, 2).mean((1, 3))
    torch.testing.assert_close(patches[0, 0], torch.from_numpy(expected).float())
    assert bool(patches[0, 1].isnan().any())
    assert bool(patches[0, 1, :, 12:].isfinite().all())
    assert bool(patches[1].isnan().all())
