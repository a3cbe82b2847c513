"""The tables on the pages show the committed results."""

import pytest

from scripts.benchmarks import honesty_moves, honesty_prediction
from scripts.output import read_json
from scripts.results import formats, write_back

TABLES = {
    "steady rigs": (honesty_moves, honesty_moves.steady_table),
    "moves": (honesty_moves, lambda result: honesty_moves.faults_table(result, "moves")),
    "images": (honesty_moves, lambda result: honesty_moves.faults_table(result, "images")),
    "predictions": (honesty_prediction, honesty_prediction.table),
    "formats": (formats, formats.table),
    "files written back": (write_back, write_back.table),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_page_shows_the_committed_result(name):
    script, table = TABLES[name]
    assert table(read_json(script.RESULT)) in script.PAGE.read_text("utf-8")
