import io
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from rich.console import Console

from imgcal.cli import watch_display as module
from imgcal.cli.watch_display import Display
from imgcal.watch import CameraBlobs, Exposure, SourceReader, Tally, Unreadable
from tests.imgcal.watch.states import RIG, event, some_state


class Nothing:
    live = False

    def items(self):
        yield Unreadable("junk")


def display(monkeypatch, terminal):
    text = io.StringIO()
    with SourceReader(Nothing(), RIG) as intake:
        intake.next(1.0)
    monkeypatch.setattr(module, "SAID_EVERY", 0.0)
    monkeypatch.setattr(module, "DRAWN_EVERY", 0.0)
    return Display(Console(file=text, force_terminal=terminal, width=200), intake), text, Tally()


def test_plain_lines_where_nobody_looks(monkeypatch):
    shown, text, tally = display(monkeypatch, False)
    with shown.show_tally(tally):
        shown.draw()
        shown.show_event(event(3, "camera_lost", message="cam02 [red]is lost[/red]"))
        shown.warn("state.json: disk\nfull")
        tally.latest, tally.snapshots, tally.refused = some_state(), 5, 2
        shown.draw()
    first, second, third, last = text.getvalue().splitlines()
    assert first.startswith("waiting for the first snapshot: junk | 0 snapshots, 0/s | 1 unreadable")
    assert second.endswith(" camera lost: cam02 [red]is lost[/red]") and third == "note: state.json: disk full"
    assert last.startswith("all 4 cameras are calibrated | 5 snapshots") and "2 refused" in last and "\x1b" not in last


def test_what_did_not_go_as_it_should_is_told_at_the_end(monkeypatch):
    shown, _, tally = display(monkeypatch, False)
    with shown.show_tally(tally):
        tally.snapshots, tally.refused = 5, 2
        shown._intake.dropped = 3
        shown._hook = SimpleNamespace(failed=4, dropped=0)
    wrong = "2 refused | 3 dropped | 1 unreadable | 4 hooks failed | latest unreadable input: junk"
    assert shown.result(Path("out/rig.yaml")) == f"5 snapshots, 0 events: out/rig.yaml | {wrong}"


def test_one_line_that_changes_in_a_terminal(monkeypatch):
    shown, text, tally = display(monkeypatch, True)
    with shown.show_tally(tally):
        shown.draw()
        shown.show_event(event())
        shown.draw()
    assert "\x1b" in text.getvalue() and text.getvalue().count("moved: cam02 moved") == 1


def test_cameras_whose_stamps_go_with_no_other_are_named(monkeypatch):
    shown, _, tally = display(monkeypatch, False)
    shown._intake.synchronizer.alone, shown._intake.synchronizer.leaps = ("cam02",), 3
    with shown.show_tally(tally):
        said = "cam02: time stamps more than 5 ms (--tolerance) off the other cameras': set their clocks"
        assert "| 3 jumps of all clocks |" in shown.line() and shown.line().endswith(f"| {said}")


def test_time_stamps_that_do_not_advance_are_told_now_and_at_the_end(monkeypatch):
    shown, _, tally = display(monkeypatch, False)
    for _ in range(100):
        shown._intake.synchronizer.add(Exposure("cam02", 5.0, CameraBlobs.of([])))
    said = "| cam02: most time stamps repeat an earlier one: give each exposure its own"
    with shown.show_tally(tally):
        assert shown.line().endswith(said) and said in shown.result(Path("out/rig.yaml"))


def test_a_camera_that_shakes_is_named(monkeypatch):
    shown, _, tally = display(monkeypatch, False)
    tally.latest = replace(some_state(), shake=np.array([0.0, 0.1532, 0.0, 0.0]))
    with shown.show_tally(tally):
        assert shown.line().endswith("| cam02 shakes by 0.15 px")


def test_a_clock_that_is_off_is_named(monkeypatch):
    shown, _, tally = display(monkeypatch, False)
    offset, sigma = np.array([0.0, 0.004, np.nan, 0.001]), np.array([1e-4, 1e-4, np.nan, 1e-3])
    tally.latest = replace(some_state(), clock_offset=offset, clock_offset_sigma=sigma)
    tally.stamps = {"cam02": -0.0005}
    with shown.show_tally(tally):
        assert shown.line().endswith("| cam02 exposes +4.5 ms off its time stamps")
