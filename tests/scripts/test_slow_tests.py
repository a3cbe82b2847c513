"""Slow tests are chosen by their durations, and the list names existing tests."""

from pathlib import Path

from scripts.slow_tests import LIST, slowest

LOG = """
= slowest durations =
5.00s call     tests/a/test_one.py::test_x[case 1]
4.00s setup    tests/a/test_one.py::test_x[case 2]
3.00s call     tests/a/test_two.py::test_y
0.50s call     tests/a/test_two.py::test_z
= 4 passed =
"""


def test_the_slowest_are_named_until_the_rest_fits():
    assert slowest(LOG, 100.0) == {}
    assert slowest(LOG, 4.0) == {"tests/a/test_one.py::test_x": 9.0}
    assert slowest(LOG, 0.6) == {"tests/a/test_one.py::test_x": 9.0, "tests/a/test_two.py::test_y": 3.0}


def test_a_file_with_a_long_setup_is_one_entry():
    log = LOG + "20.00s setup    tests/a/test_three.py::test_u\n1.00s call     tests/a/test_three.py::test_v\n"
    assert slowest(log, 13.0) == {"tests/a/test_three.py": 21.0}


def test_every_line_of_the_list_names_a_test_that_is_there():
    root = Path(__file__).parents[2]
    for line in LIST.read_text().splitlines():
        if not line.startswith("#"):
            assert (root / line.split()[0].partition("::")[0]).exists(), line
