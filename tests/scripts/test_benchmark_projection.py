"""The projection benchmark runs, and all tools agree on pixels and derivatives."""

from pathlib import Path

import numpy as np
import pytest
import torch

from scripts.benchmarks import projection
from scripts.benchmarks.effort import Effort
from scripts.output import read_json, write_json

KINDS = (("camera", 40), ("rigs", 3))


def test_runs(tmp_path: Path) -> None:
    write_json(tmp_path / "projection.json", projection.measure(Effort(smoke=True)))
    result = read_json(tmp_path / "projection.json")
    tables = projection.tables(result)
    assert set(tables) == {"projection camera", "projection rigs", "projection derivatives", "synthesis"}
    assert projection.COLMAP in tables["projection rigs"]
    projection.draw(result, tmp_path / "projection.png")
    assert (tmp_path / "projection.png").stat().st_size > 1000


@pytest.mark.parametrize(("kind", "count"), KINDS)
def test_all_find_the_same_pixels(kind: str, count: int) -> None:
    cases = projection.value_cases(projection.scene_of(kind, count))
    expected = cases[projection.OPENCV]
    assert expected is not None
    for name, run in cases.items():
        if run is not None:
            limit = 1e-3 if name == projection.OURS_SINGLE else 1e-9
            np.testing.assert_allclose(np.asarray(run()), expected(), rtol=0, atol=limit, err_msg=name)


def test_pycolmap_is_among_them() -> None:
    pytest.importorskip("pycolmap")
    assert projection.value_cases(projection.scene_of("rigs", 1))[projection.COLMAP] is not None


@pytest.mark.parametrize(("kind", "count"), KINDS)
def test_all_find_the_same_derivatives(kind: str, count: int) -> None:
    scene = projection.scene_of(kind, count)
    shape = (count if kind == "rigs" else 1, scene.rig.num_cameras, len(scene.points_object), 2)
    upstream = torch.randn(shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    cases = projection.derivative_cases(scene, upstream)
    assert set(cases) == set(projection.COMPUTES)
    found = {name: np.asarray(take(run())) for name, (run, take) in cases.items()}
    expected = found[projection.OPENCV]
    for name, value in found.items():
        np.testing.assert_allclose(value, expected, rtol=0, atol=1e-9 * np.abs(expected).max(), err_msg=name)
