"""Drawings are XML that any reader takes, whatever is written into them; places follow the axes. Ticks: test_charts."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from imgcal.report import svg
from imgcal.report.svg import Axes, drawing

AXES = Axes(40, 240, 10, 110, x_range=(-5.0, 5.0), y_range=(0.0, 2.0))
NASTY = "<script>&\"'"


def parse(*parts: str) -> ElementTree.Element:
    return ElementTree.fromstring(str(drawing(300, 150, NASTY, *parts)))


def test_data_lie_between_the_edges() -> None:
    np.testing.assert_allclose(AXES.x(np.array([-5, 0, 5])), [40, 140, 240])
    np.testing.assert_allclose(AXES.y(np.array([0, 1, 2])), [110, 60, 10])
    assert float(AXES.x(2.5)) == 190


def test_all_words_are_escaped() -> None:
    root = parse(svg.text(1, 2, NASTY), svg.box(0, 0, 5, 6, "bar", NASTY), svg.grid(AXES, NASTY, NASTY))
    assert root.attrib["aria-label"] == NASTY
    words = [element.text for element in root.iter() if element.text]
    assert words.count(NASTY) == 4
    assert not [element for element in root.iter() if element.tag.endswith("script")]


def test_every_dot_is_drawn_once() -> None:
    x, y = np.random.default_rng(0).uniform(0, 100, (2, 451))
    root = parse(svg.dots(x, y, "dot", per_path=200))
    paths = [element.attrib["d"] for element in root if element.attrib.get("class") == "dot"]
    assert [path.count("M") for path in paths] == [200, 200, 51]
    first = paths[0].split("h0")[0].removeprefix("M").split()
    np.testing.assert_allclose([float(value) for value in first], [x[0], y[0]], atol=0.051)
    assert svg.dots(np.array([]), np.array([]), "dot") == ""


def test_lines_and_boxes_have_their_corners() -> None:
    root = parse(
        svg.line(1, 2.25, 3, 4, "a"),
        svg.polyline(np.array([0.0, 1, 2]), np.array([5.0, 6, 7]), "b"),
        svg.box(1, 2, -3, 4, "c"),
    )
    line, polyline, box = root
    assert line.attrib["d"] == "M1 2.2L3 4" and polyline.attrib["d"] == "M0 5L1 6L2 7"
    assert (box.attrib["width"], box.attrib["height"]) == ("0", "4")  # nothing is drawn backwards


def test_a_grid_has_a_line_for_every_label() -> None:
    for log, labels in ((False, {"−4", "−2", "0", "2", "4"}), (True, None)):
        axes = Axes(40, 240, 10, 110, x_range=(0.0, 3.0) if log else (-5.0, 5.0), y_range=(0.0, 2.0))
        root = parse(svg.grid(axes, log_x=log))
        texts = {element.text for element in root if element.tag.endswith("text")}
        lines = [element for element in root if element.attrib.get("class") == "grid"]
        assert len(lines) == len(texts)
        assert texts == ({"1", "10", "100", "1000"} if log else labels)


@pytest.mark.parametrize(
    ("value", "expected"), [(1.0, "1"), (1.04, "1"), (-0.04, "0"), (-1.26, "-1.3"), (1234.56, "1234.6")]
)
def test_coordinates_are_short(value: float, expected: str) -> None:
    assert svg.number(value) == expected


def test_words_for_people() -> None:
    assert svg.group_digits(1234567) == "1\u202f234\u202f567" and svg.tick_label(-0.5) == "\u22120.5"
    assert svg.shorten_name("a" * 16) == "a" * 16 and svg.shorten_name("a" * 17) == "a" * 15 + "…"
