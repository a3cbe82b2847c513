import json
import sys

import pytest

from scripts.benchmarks import endurance


@pytest.mark.benchmark
def test_a_quarter_of_an_hour(tmp_path, monkeypatch):
    words = ["--hours", "0.25", "--minutes", "3", "--bumps", "1", "--steady", "400", "--out", str(tmp_path / "a.json")]
    monkeypatch.setattr(sys, "argv", ["endurance", *words])
    endurance.main()
    result = json.loads((tmp_path / "a.json").read_text())
    assert result["killed_day"]["wrong_while_ok"] == 0 and result["killed_day"]["kills"] >= 1
    assert result["steady"]["snapshots"] > 300
