"""Committed benchmark results are complete, within their targets, and shown on their pages."""

from scripts.benchmarks import honesty_moves, honesty_prediction, image_quality, open_igt_link, qualisys_stream
from scripts.output import read_json
from scripts.results import formats, write_back


def test_moves_are_whole_and_shown():
    result = read_json(honesty_moves.RESULT)
    kinds = len(honesty_moves.SCENES)
    assert set(result["steady"]) == set(honesty_moves.STEADY)
    assert len(result["moves"]) == kinds * len(honesty_moves.DEGREES) * len(honesty_moves.SHARES)
    assert len(result["images"]) == kinds * len(honesty_moves.IMAGES)
    page = honesty_moves.PAGE.read_text("utf-8")
    assert honesty_moves.steady_table(result) in page
    assert all(honesty_moves.faults_table(result, part) in page for part in ("moves", "images"))


def test_nothing_wrong_was_accepted_and_steady_rigs_were_left_alone():
    result = read_json(honesty_moves.RESULT)
    assert all(row["accepted"] == 0 for row in result["images"].values())
    usual = [row for name, row in result["steady"].items() if not name.endswith("one way")]
    assert sum(row["alarms"] for row in usual) <= 0.001 * sum(row["captures"] for row in usual)
    # A third of a pixel in two of twenty snapshots of a wand is not to be seen.
    plain = [row for name, row in result["moves"].items() if "0.02 deg" not in name]
    assert sum(row["accepted"] for row in plain) <= 0.02 * sum(sum(row.values()) for row in plain)


def test_predictions_are_complete_within_the_gate_and_on_the_page():
    result = read_json(honesty_prediction.RESULT)
    expected = dict.fromkeys(honesty_prediction.RIGS, honesty_prediction.SNAPSHOTS)
    assert {rig: tuple(map(int, sizes)) for rig, sizes in result["rigs"].items()} == expected
    low, high = honesty_prediction.GATE
    for row in (row for sizes in result["rigs"].values() for row in sizes.values()):
        assert row["captures"] >= 200 and row["refused"] == 0
        assert all(low < row[unit]["ratio"] < high for unit in ("px", "mm"))
    assert honesty_prediction.table(result) in honesty_prediction.PAGE.read_text("utf-8")


def test_formats_are_read_and_written_as_their_tools_have_them():
    result = read_json(formats.RESULT)
    for name, row in result["formats"].items():
        assert row["read"]["worst_px"] < 1e-6, name
        if row["write"] is not None:
            assert row["write"]["own_reader_px"] < 1e-8, name
            assert row["write"]["reader"] is None or row["write"]["worst_px"] < 1e-6, name
    verified = {name for name, row in result["formats"].items() if row["write"] and row["write"]["reader"]}
    assert verified == set(formats.READERS)
    assert formats.table(result) in formats.PAGE.read_text("utf-8")


def test_image_quality_has_no_false_alarm_and_finds_every_fault():
    found = read_json(image_quality.RESULT)["found"]
    assert set(found) == set(image_quality.PARTS)
    runs = {name: part.get("runs", [part]) for name, part in found.items()}
    for name in image_quality.QUIET:
        assert all(run["events"] == [] for run in runs.pop(name)), name
    for name, every in runs.items():
        assert all(run["seconds"] <= image_quality.IN_TIME[name] and run["false"] == 0 for run in every), name


def test_rigs_go_back_into_the_files_of_every_tool():
    result = read_json(write_back.RESULT)
    names = {row["format"] for row in result["files"]}
    assert names == set(write_back.READERS) >= {"vicon", "motive", "qualisys"}
    assert {row["format"] for row in result["files"] if row["real"]} >= names - {"vicon", "caliscope-config"}
    for row in result["files"]:
        assert row["recalibrated"] == row["cameras"] and row["moved_px"] > 0.5 and row["numbers"] > 0, row
        allowed = row["loss_px"] + write_back.ROUNDING
        assert row["loss_px"] <= row["limit_px"] and max(row["own_reader_px"], row["reader_px"]) <= allowed, row
    damaged = result["damaged"]
    assert damaged["refused"] >= 300 and damaged["faults"] == [] and damaged["sound_and_right"] > 0
    assert set(damaged["refused_by_format"]) == names
    assert write_back.table(result) in write_back.PAGE.read_text("utf-8")


def test_qtm_gives_the_events_of_a_file_and_a_client_every_pose():
    stream = read_json(qualisys_stream.RESULT)
    assert (stream["cameras"], stream["rate_hz"], stream["events_that_differ"], stream["rigs_differ_in"]) == (
        10,
        100,
        0,
        None,
    )
    assert stream["frames_lost"] and stream["unreadable_packets"] and stream["reconnections"] >= qualisys_stream.BREAKS
    assert set(stream["moved"]) == {stream["turned"]} and stream["snapshots"] >= 1900
    assert abs(read_json(open_igt_link.RESULT)["published"]["poses_a_second"] - 60) < 0.1
