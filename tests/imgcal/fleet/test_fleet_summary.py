import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import imgcal
from imgcal.fleet import Dataset, DriftInformation, Item, Settings, Trend, parameter_units, refusals, rig_kinds
from imgcal.fleet.job import failed_row, process
from imgcal.formats.writing import HELD_DISTORTION
from tests.imgcal.fleet.small_captures import write_capture
from tests.imgcal.lensed import lensed


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """Nine devices; the first was seen twice."""
    dataset, rows = Dataset(tmp_path), list[dict[str, Any] | None]()
    for number in range(10):
        path = tmp_path / f"{number}.csv"
        write_capture(path, number)
        device = "d0" if number == 9 else f"d{number}"
        given = (("temperature", 20.0 + number), *([("hours", 1.0)] if number else []))
        rows.append(process(Item(number, str(path), "T4", "asymmetric8", device, 86400.0 * number, given), Settings()))
    with dataset.open_writer() as writer:
        writer.add([row for row in rows if row is not None])
        writer.add([failed_row(Item(11, "x", "T4", "cube8", "d11", None), "crashed", "signal: 9")])
    return dataset


def test_the_last_word_of_every_device(dataset: Dataset) -> None:
    (kind,) = rig_kinds(dataset)
    assert kind.cameras == imgcal.load_rig("T4").camera_names
    assert sorted(kind.devices) == [f"d{number}" for number in range(9)]
    assert kind.given["temperature"][kind.devices.index("d0")] == 29.0  # its second capture
    assert len(kind.learn(("temperature",)).spreads) == 5
    with pytest.raises(imgcal.InputError, match="found pressure"):
        kind.learn(("pressure",))


def test_what_a_row_keeps_is_what_the_estimate_said(dataset: Dataset, tmp_path: Path) -> None:
    (kind,) = rig_kinds(dataset)
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    result = imgcal.calibrate(imgcal.load_detections(tmp_path / "3.csv", rig), rig, obj)
    direct, kept = (
        DriftInformation.from_estimates(result.estimate),
        kind.drift[torch.tensor([kind.devices.index("d3")])],
    )
    by_prior = (parameter_units(rig) / result.estimate.problem.prior_std[0]).flatten().square()
    scale = (direct.information.diagonal(dim1=1, dim2=2) + by_prior).sqrt()
    apart = (direct.information - kept.information) / (scale[:, :, None] * scale[:, None, :])
    assert float(apart.abs().max()) < 1e-6
    np.testing.assert_allclose(kept.score / scale, direct.score / scale, rtol=1e-4, atol=1e-3)


def test_rigs_of_other_lenses_are_another_kind_and_their_values_have_their_own_names(tmp_path: Path) -> None:
    """Cameras of the same names, with mixed lenses here and the usual ones there, in one fleet."""
    usual = imgcal.load_rig("T4")
    mixed, dataset, rows = lensed(usual, "mixed"), Dataset(tmp_path / "out"), list[dict[str, Any] | None]()
    imgcal.save_rig(mixed, tmp_path / "mixed.yaml")
    for number in range(10):
        rig, name = (usual, "T4") if number == 9 else (mixed, str(tmp_path / "mixed.yaml"))
        write_capture(tmp_path / f"{number}.csv", number, rig)
        item = Item(number, str(tmp_path / f"{number}.csv"), name, "asymmetric8", f"d{number}", None)
        rows.append(process(item, Settings()))
    with dataset.open_writer() as writer:
        writer.add([row for row in rows if row is not None])
    kept = dataset.latest(("cameras", "lenses", "parameters", "offset", "status")).to_pylist()
    assert {row["status"] for row in kept} == {"ok"}
    assert kept[0]["lenses"] == ["equidistant", "brown_conrady", "rational", "equidistant"]
    assert kept[9]["lenses"] == ["brown_conrady"] * 4
    assert len(kept[0]["parameters"]) == len(kept[0]["offset"]) == 4 * 18
    assert kept[0]["parameters"][10:18] == ["k1", "k2", "k3", "k4", "-", "-", "-", "-"]
    assert kept[0]["parameters"][46:54] == ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
    first, second = rig_kinds(dataset)
    assert (len(first.devices), len(second.devices)) == (9, 1)
    assert first.lenses == mixed.lens_models
    learnt = first.learn()
    assert all(0 <= spread.value < 100 for spread in learnt.spreads)
    names = [first.parameter_name(Trend("t", camera, 12, 0.0, 0.0)) for camera in first.cameras]
    assert names == ["k3", "p1", "p1", "k3"]


def test_values_that_the_prior_holds_are_not_learned(tmp_path: Path) -> None:
    rig = imgcal.load_rig("T4")
    assert rig.prior is not None
    held = replace(rig, prior=replace(rig.prior, distortion=HELD_DISTORTION))
    imgcal.save_rig(held, tmp_path / "held.yaml")
    dataset, rows = Dataset(tmp_path / "out"), list[dict[str, Any] | None]()
    for number in range(8):
        path = tmp_path / f"{number}.csv"
        write_capture(path, number)
        rows.append(process(Item(number, str(path), str(tmp_path / "held.yaml"), "asymmetric8", "", None), Settings()))
    with dataset.open_writer() as writer:
        writer.add([row for row in rows if row is not None])
    (kind,) = rig_kinds(dataset)
    assert kind.devices == tuple(str(tmp_path / f"{number}.csv") for number in range(8))  # captures stand for devices
    found = {spread.kind: spread for spread in kind.learn().spreads}
    assert found["distortion"].sigma == math.inf
    assert 0.001 < found["rotation"].value < 0.01 and found["rotation"].sigma < 0.001


def test_results_from_before_lenses_were_written_are_of_the_usual_ones(dataset: Dataset, monkeypatch: Any) -> None:
    import pyarrow as pa

    latest = Dataset.latest
    older: Any = lambda self, columns=None: pa.table(latest(self, columns)).drop_columns(["lenses"])  # noqa: E731
    monkeypatch.setattr(Dataset, "latest", older)
    (kind,) = rig_kinds(dataset)
    assert kind.lenses == ("brown_conrady",) * 4


def test_reasons_are_counted(dataset: Dataset) -> None:
    assert refusals(dataset)[0] == ("ok", "", 10)
    assert ("crashed", "signal", 1) in refusals(dataset)
