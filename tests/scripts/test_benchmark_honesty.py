import json

from imgcal import load_object, load_rig
from scripts.benchmarks.honesty import effort, judged, recovered, tables
from scripts.benchmarks.honesty_attacks import ATTACKS, BENT
from scripts.benchmarks.honesty_prediction import Case


def test_every_attack_runs_and_every_outcome_is_counted():
    case = Case(load_rig("T4"), load_object("asymmetric8"), 3, 0.05)
    rows = []
    for name, attack in ATTACKS.items():
        row = judged(case, attack, 1, seed=1)
        assert row["right"] + row["said"] + row["silent"] + row["refused"] == 1
        rows.append({"rig": "T4", "snapshots": 1, "tolerance_mm": 0.0, "attack": name, "captures": 1} | row)
    wands = {name: recovered((name, 1, 2)) for name in BENT}
    assert all(row["named"] == row["within"] == 1 and row["refused"] == 0 for row in wands.values())
    result = {"rows": rows, "bent_wand": wands, "estimate_seconds": effort(2)}
    assert len(tables(json.loads(json.dumps(result)))) == 3
