from dataclasses import replace

import pytest
import torch

from imgcal.association import PipelineOptions
from imgcal.io import load_object, read_rig
from scripts.benchmarks.honesty_prediction import Case, judge, measure, table


@pytest.mark.parametrize(("rig", "snapshots"), [("U7", 5), ("T4", 20)])
def test_predicted_errors_are_the_true_ones(rig, snapshots):
    row = judge(Case(read_rig(rig), load_object("asymmetric8"), snapshots), 12, 0, PipelineOptions())
    assert row["refused"] == 0
    assert 0.92 < row["px"]["ratio"] < 1.08
    assert 0.75 < row["mm"]["ratio"] < 1.25


def test_true_rigs_spread_as_the_prior_says():
    case = Case(read_rig("T4"), load_object("asymmetric8"), 1)
    generator = torch.Generator().manual_seed(0)
    drift = torch.stack([case.draw(generator)[0].local(case.rig) for _ in range(50)])
    assert abs(float((drift / case.rig.prior.std(case.rig)).square().mean()) - 1) < 0.1


def test_true_objects_spread_as_the_tolerance_says():
    obj = load_object("wand4")
    loose = replace(obj, tolerance=torch.full((4,), 0.2, dtype=torch.float64), scale_tolerance=0.01)
    case = Case(read_rig("room10"), loose, 3)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.stack([case.true_object(generator).points for _ in range(200)])
    lengths = (drawn[:, 3] - drawn[:, 0]).norm(dim=1) / (obj.points[3] - obj.points[0]).norm()
    assert abs(float(lengths.std()) / 0.01 - 1) < 0.15
    spread = (drawn - drawn.mean(0))[:, 1].std(0)
    assert torch.allclose(spread[1:], torch.full((2,), 0.2, dtype=torch.float64), rtol=0.15)
    assert Case(read_rig("room10"), obj, 3).true_object(generator) is obj
    assert 0.5 < judge(case, 8, 1, PipelineOptions())["px"]["ratio"] < 1.5


def test_all_kinds_run():
    result = measure(1, (2,))
    assert list(result["rigs"]) == ["O10", "U7", "T4", "room10"]
    assert table(result).count("\n") == 5
