import pytest
import torch

from imgcal.errors import InputError
from imgcal.synthesis import Corruption
from imgcal.synthesis.corruption import FALSE, SWAPPED
from imgcal.types import Views

SIZE = torch.tensor([[200, 100], [64, 48], [300, 300]])


def views(batch: int = 40, cameras: int = 3, fiducials: int = 7) -> Views:
    uv = torch.arange(batch * cameras * fiducials * 2, dtype=torch.float64).reshape(batch, cameras, fiducials, 2)
    seen = torch.rand(uv.shape[:-1], generator=torch.Generator().manual_seed(9)) > 0.1
    return Views(uv=uv, seen=seen)


def apply(corruption: Corruption, given: Views, seed: int = 0):
    return corruption.apply(given, SIZE, torch.Generator().manual_seed(seed))


def test_nothing_wrong_leaves_what_is_seen_and_hides_the_rest():
    given = views()
    result = apply(Corruption(), given)
    assert torch.equal(result.views.seen, given.seen)
    assert torch.equal(result.inlier, given.seen)
    assert torch.equal(result.views.uv[given.seen], given.uv[given.seen])
    assert (result.views.uv[~given.seen] == 0).all()


def test_noise_has_the_given_standard_deviation():
    given = views(400)
    result = apply(Corruption(noise=0.5), given)
    difference = (result.views.uv - given.uv)[given.seen]
    assert float(difference.std()) == pytest.approx(0.5, rel=0.03)
    assert float(difference.mean().abs()) < 0.02


def test_missing_fiducials_are_not_seen_and_leave_no_trace():
    given = views(400)
    result = apply(Corruption(missing=0.3), given)
    assert not (result.views.seen & ~given.seen).any()
    assert float(result.views.seen.sum() / given.seen.sum()) == pytest.approx(0.7, abs=0.02)
    assert (result.views.uv[~result.views.seen] == 0).all()


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_swapped_labels_exchange_places_of_seen_fiducials_of_one_camera(share):
    given = views(400)
    result = apply(Corruption(swapped=share), given)
    swapped = (result.fault == SWAPPED) & result.views.seen
    assert torch.equal(result.views.seen, given.seen)
    # The points of a camera stay the same points, and each exchanged one has its partner's place.
    for camera_before, camera_after, seen in zip(
        given.uv.flatten(0, 1), result.views.uv.flatten(0, 1), given.seen.flatten(0, 1), strict=True
    ):
        before, after = camera_before[seen], camera_after[seen]
        source = (after[:, None] == before[None]).all(-1)
        assert torch.equal(source.sum(0), torch.ones(len(before), dtype=torch.int64))
        assert torch.equal(source, source.T)
    odd = (given.seen.sum(-1) % 2 == 1).sum()
    expected = share * given.seen.sum() - (odd if share == 1 else 0)
    assert float(swapped.sum()) == pytest.approx(float(expected), rel=0.07)
    assert torch.equal(result.inlier, given.seen & ~swapped)
    assert torch.equal(result.views.uv[result.inlier], given.uv[result.inlier])


def test_false_blobs_are_anywhere_in_the_image():
    given = views(600)
    result = apply(Corruption(false=0.5), given)
    false = result.views.seen & (result.fault == FALSE)
    assert float(false.sum() / given.seen.sum()) == pytest.approx(0.5, abs=0.02)
    assert not (result.inlier & false).any()
    for camera, (width, height) in enumerate(SIZE.tolist()):
        uv = result.views.uv[:, camera][false[:, camera]]
        assert (uv >= -0.5).all()
        assert (uv[:, 0] <= width - 0.5).all()
        assert (uv[:, 1] <= height - 0.5).all()
        expected = torch.tensor([width, height], dtype=torch.float64) / 2 - 0.5
        assert torch.allclose(uv.mean(0), expected, rtol=0.05)


def test_more_corruption_hits_the_same_fiducials_and_more():
    given = views()
    little, much = apply(Corruption(missing=0.1), given), apply(Corruption(missing=0.3), given)
    assert not (much.views.seen & ~little.views.seen).any()
    assert much.views.seen.sum() < little.views.seen.sum()


def test_equal_generators_give_equal_corruption():
    given, corruption = views(), Corruption(0.1, 0.2, 0.3, 0.1)
    first, second = apply(corruption, given, 3), apply(corruption, given, 3)
    assert torch.equal(first.views.uv, second.views.uv)
    assert torch.equal(first.inlier, second.inlier)


@pytest.mark.parametrize(
    "values", [{"noise": -1.0}, {"noise": float("nan")}, {"missing": 1.1}, {"swapped": -0.1}, {"false": float("nan")}]
)
def test_impossible_values_are_refused(values):
    with pytest.raises(InputError, match=next(iter(values))):
        Corruption(**values)
