"""The benchmark of identity runs at a minimal size, and the baseline finds the object."""

import json

import numpy as np
import pytest

from scripts.benchmarks import identity
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.identity import EACH, NEAREST, OURS, VOTE, Case, Count, Peers, snapshots_of


def test_smoke(tmp_path):
    result = json.loads(json.dumps(identity.measure(Effort(smoke=True))))
    tables = identity.tables(result)
    assert set(tables) == {"identity", "identity time", "identity known pose"}
    assert identity.BASE.name in tables["identity"]
    for row in result["cases"].values():
        assert row[OURS]["accepted_percent"] == 100 and row[OURS]["wrong_labels"] == 0
    identity.draw(result, tmp_path / "identity.png")
    assert (tmp_path / "identity.png").stat().st_size > 1000


def test_an_absent_baseline_is_a_column_that_says_so(monkeypatch):
    monkeypatch.setattr(identity, "peer", lambda name: None)
    result = json.loads(json.dumps(identity.measure(Effort(smoke=True))))
    assert identity.tables(result)["identity"].splitlines()[3].endswith("| absent | absent |")


@pytest.mark.parametrize("name", ["asymmetric8", "cube8"])
def test_the_baseline_is_right_where_nothing_is_in_the_way(name):
    pytest.importorskip("poselib")
    rig, obj, [snapshot] = snapshots_of(Case("", visible=7, false=0, kappa=0.0, object_name=name), 1)
    found = Peers(rig, obj).decide(snapshot)
    named = {VOTE, NEAREST} if name == "cube8" else {VOTE, NEAREST, EACH}  # cameras by themselves disagree about a cube
    for method in named:
        count = Count()
        count.add(found[method][1], found[method][0], snapshot.truth, obj)
        assert count.wrong_labels == 0 and count.right_labels > 0.9 * (snapshot.truth >= 0).sum(), method


def test_one_wrong_label_makes_a_snapshot_wrong():
    _, obj, [snapshot] = snapshots_of(Case("", false=1), 1)
    labels, count = snapshot.truth.copy(), Count()
    labels[np.flatnonzero(snapshot.truth < 0)[0]] = 3
    for given in (snapshot.truth, labels, np.full_like(labels, -1)):
        count.add(1.0, given, snapshot.truth, obj)
    summary = count.summary()
    assert summary["wrong_percent"] == pytest.approx(100 / 3) and summary["wrong_labels"] == 1
    assert summary["accepted_percent"] == pytest.approx(200 / 3)
