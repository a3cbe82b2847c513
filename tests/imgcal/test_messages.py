"""Messages stay readable, whatever they quote."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from imgcal.messages import (
    LONGEST,
    MOST_QUOTED,
    brief_repr,
    list_names,
    name_cameras,
    name_several,
    one_line,
    plural,
    quote,
    shorten,
    with_article,
)


@pytest.mark.parametrize("length", [0, 1, 40, 41, 10_000])
def test_names_are_kept_or_cut(length: int) -> None:
    found = shorten("n" * length)
    assert found == "n" * length if length <= 40 else found == "n" * 37 + "..."


@pytest.mark.parametrize("length", [0, MOST_QUOTED, MOST_QUOTED + 1, 10**6])
def test_quotes_are_kept_or_cut(length: int) -> None:
    found = quote("q" * length)
    assert len(found) == min(length, MOST_QUOTED) and found.endswith("...") == (length > MOST_QUOTED)


def test_lists_say_how_many_they_leave_out() -> None:
    assert list_names([]) == "" and list_names(["a", "b"]) == "a, b"
    names = [f"camera{n:03}" for n in range(300)]
    found = list_names(iter(names))
    assert found == "camera000, camera001, camera002, camera003, ... (300 in all)"
    assert len(list_names(["x" * 5000] * 5000)) < MOST_QUOTED + 50


def test_one_of_a_kind_is_singular() -> None:
    assert [plural(count, "event") for count in (0, 1, 2, 1200)] == ["0 events", "1 event", "2 events", "1,200 events"]


def test_articles_fit_the_noun() -> None:
    assert [with_article(noun) for noun in ("ROS file", "OpenCV pair")] == ["a ROS file", "an OpenCV pair"]


def test_one_line_is_one_line_of_text() -> None:
    assert one_line("two\n  lines\t and   a gap ") == "two lines and a gap"
    found = one_line("bell \a, escape \x1b[31m, a line separator \u2028, umlaut ä")
    assert found == "bell \\x07, escape \\x1b[31m, a line separator , umlaut ä"
    assert found.isprintable()


def test_a_long_message_keeps_both_its_ends() -> None:
    found = one_line("begin " + "x" * 5000 + " end")
    assert len(found) == LONGEST and found.startswith("begin x") and found.endswith("x end") and "..." in found


def test_a_dataclass_of_tensors_shows_shapes() -> None:
    @dataclass
    class Seen:
        uv: torch.Tensor
        camera: np.ndarray
        names: tuple[str, ...]
        more: float = 1.5
        hidden: int = field(default=0, repr=False)
        __repr__ = brief_repr

    found = repr(Seen(torch.zeros(4, 0, 2), np.zeros(3, np.int64), ("a", "b", "c", "d", "e")))
    assert found == "Seen(uv=float32(4, 0, 2), camera=int64(3,), names=('a', ..., 'e': 5), more=1.5)"


def test_cameras_in_a_sentence() -> None:
    assert name_cameras(["a"]) == "camera a"
    assert name_cameras([str(n) for n in range(9)]) == "cameras 0, 1, 2, 3, 4, 5, 6, 7, 8"
    assert name_cameras(f"camera{n:03}" for n in range(300)).endswith("camera003, ... (300 in all)")
    assert name_several("fiducial", ["3", "5"]) == "fiducials 3, 5"
