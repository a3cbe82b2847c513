import pytest

from imgcal.io import read_metrics


@pytest.mark.parametrize("line", ["[1]", "3", '{"step": "x"}', "[" * 100_000, "\xff\x00", "{"])
def test_metrics_end_at_the_first_line_that_is_none(line, tmp_path):
    (tmp_path / "metrics.jsonl").write_bytes(b'{"step": 1}\n' + line.encode("latin1") + b'\n{"step": 2}\n')
    assert read_metrics(tmp_path / "metrics.jsonl") == [{"step": 1}]
