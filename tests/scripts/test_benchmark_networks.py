"""The benchmark of networks runs, on next to nothing."""

import json

from scripts.benchmarks import networks
from scripts.benchmarks.effort import Effort


def test_smoke(tmp_path):
    result = json.loads(json.dumps(networks.measure(Effort(smoke=True))))
    table = networks.tables(result)[networks.LATENCY]
    assert "**points-O10-cube8**" in table and "paper-cnn1d, as in the paper" in table
    networks.draw(result, tmp_path / "networks.png")
    assert (tmp_path / "networks.png").stat().st_size > 1000
    for row in result["networks"].values():
        assert 0 < row["alone"]["best"] <= row["alone"]["p50"] <= row["alone"]["p99"]
