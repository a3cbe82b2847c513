"""The benchmark of blob finders: it runs, and finders and limit are right on frames that all of them can read."""

import json
from dataclasses import replace

import numpy as np
import pytest

from scripts.benchmarks import blobs
from scripts.benchmarks.blob_scenes import CELLS, CENTRE, bound, view
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peers.blob_finders import FINDERS, present
from tests.imgcal.detection.discs import nearest

WHOLE_PIXELS = ("skimage blob_log", "skimage blob_dog", "photutils IRAFStarFinder")


@pytest.fixture(scope="module")
def scene():
    return view(CENTRE, (120, 160), np.random.default_rng(0))


@pytest.mark.parametrize("name", FINDERS)
def test_finders_agree(scene, name):
    if not present(name):
        pytest.skip(f"{name} is not installed")
    found = FINDERS[name](scene.frame, CENTRE.known)
    _, distance = nearest(found, scene.uv)
    assert len(found) == len(scene.uv) == 6
    assert distance.max() < (1.0 if name in WHOLE_PIXELS else 0.3)


def test_the_limit_is_that_of_a_straight_edge():
    # A blurred edge of radius r tells A^2 sqrt(pi) r / (2 s) about the position; pixels blur by 1 / sqrt(12) more.
    cell = replace(CENTRE, radius=10.0, noise=2.0, contrast=150.0)
    blur, noise = np.hypot(cell.blur, 12**-0.5), np.sqrt(cell.noise**2 + 1 / 12)
    expected = noise / cell.contrast * np.sqrt(2 * blur / (np.sqrt(np.pi) * cell.radius))
    assert bound(cell, np.random.default_rng(0)) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("cell", CELLS, ids=[cell.name for cell in CELLS])
def test_imgcal_comes_near_the_limit(cell):
    rng = np.random.default_rng(1)
    one = view(cell, (240, 320), rng)
    errors, _ = blobs.errors_of([FINDERS["imgcal"](one.frame, cell.known)], [one])
    assert np.isfinite(errors).mean() > 0.85
    # Without the few at the border of a bright area.
    assert np.sqrt(np.nanmedian(errors**2)) < 0.6745 * 1.5 * bound(cell, rng)


def test_errors_are_counted():
    one = blobs.View(np.zeros((8, 8), np.uint8), np.array([[2.0, 3.0], [5.0, 6.0]]))
    errors, false = blobs.errors_of([np.array([[2.1, 3.0], [2.3, 3.0], [7.0, 7.0]])], [one])
    assert false == 2
    np.testing.assert_allclose(errors, [[0.1, 0.0], [np.nan, np.nan]], atol=1e-12)


def test_smoke(tmp_path):
    result = json.loads(json.dumps(blobs.measure(Effort(smoke=True))))
    tables = blobs.tables(result)
    assert set(tables) == {f"blobs {name}" for name in ("best", "accuracy", "finding", "bias", "time", "rig")}
    assert all(CENTRE.name in tables[f"blobs {name}"] for name in ("best", "accuracy", "finding", "bias"))
    assert all(name in tables["blobs time"] for name in FINDERS)
    blobs.draw(result, tmp_path / "blobs.png")
    assert (tmp_path / "blobs.png").stat().st_size > 5000
