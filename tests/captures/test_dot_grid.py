"""One camera, 15 views of a grid of 10 x 10 dark dots, from nominal intrinsics that are 2 % off."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

import imgcal
from imgcal.detection.boards import find_board
from imgcal.estimation import camera_std
from imgcal.io import read_frame, write_text
from imgcal.types import Board
from tests.captures.sets import dot_grid, nominal

HELD_OUT_LIMIT = 0.25  # px RMS, from the captures' README


@pytest.fixture(scope="module")
def grid(captures, tmp_path_factory):
    """The frames in the layout of a capture, and the grid as an object file."""
    folder = tmp_path_factory.mktemp("grid")
    (folder / "frames" / "cam").mkdir(parents=True)
    for path in sorted((captures / "dot-grid-10x10" / "frames").glob("*.png")):
        shutil.copy(path, folder / "frames" / "cam")
    rows = [f"{25.4 * column},{25.4 * row},0" for row in range(10) for column in range(10)]
    write_text(folder / "object.csv", "\n".join(["x,y,z", *rows]) + "\n")
    assert read_frame(folder / "frames" / "cam" / "00.png").shape == (480, 640)
    return folder


def test_the_first_half_of_the_views_predicts_the_second(grid, calibrate, score):
    dark = ("--polarity", "dark")
    outcome = calibrate(grid, nominal(), grid / "object.csv", "--snapshots", "0:8", *dark)
    assert outcome.code == 0, outcome.result["reason"]
    # The dots are alike: eight labellings explain a view, and the intrinsics are the same for all.
    assert outcome.result["identity"] == "ambiguous"
    assert outcome.result["snapshots_used"] == 8
    scored = score(grid, outcome.rig, grid / "object.csv", "--snapshots", "8:15", *dark)
    assert scored["rms_px"] <= HELD_OUT_LIMIT
    assert scored["snapshots_used"] == 7


@pytest.mark.parametrize("first", [0, 1])
def test_every_other_view_predicts_the_rest(first, grid):
    obj = imgcal.load_object(grid / "object.csv")
    frames = [read_frame(path) for path in sorted((grid / "frames" / "cam").glob("*.png"))]
    dark = imgcal.DetectionOptions(polarity="dark")
    found = imgcal.calibrate({"cam": frames[first::2]}, nominal(), obj, detection=dark)
    scored = imgcal.score(imgcal.detect({"cam": frames[1 - first :: 2]}, dark), found.rig, obj)
    assert scored.distances.square().mean().sqrt() <= HELD_OUT_LIMIT


def test_the_halves_differ_by_as_much_as_they_say(grid):
    """Errors of this lens go with places: by the noise of the dots alone, the halves are 8 to 9 sigma apart."""
    obj = imgcal.load_object(grid / "object.csv")
    frames = [read_frame(path) for path in sorted((grid / "frames" / "cam").glob("*.png"))]
    dark = imgcal.DetectionOptions(polarity="dark")
    halves = [imgcal.calibrate({"cam": frames[part::2]}, nominal(), obj, detection=dark) for part in (0, 1)]
    difference = halves[0].rig.local(halves[1].rig)[0, 6:10]
    variance = sum(camera_std(half.estimate)[0, 6:10].square() for half in halves)
    assert (difference.square() / variance).mean() < 4
    alone = sum(camera_std(replace(half.estimate, inflation=None))[0, 6:10].square() for half in halves)
    assert (difference.square() / alone).mean() > 20


def test_the_grid_is_found_as_a_board(captures):
    """A larger dot marks the origin; in one view it merges with the dark edge of the image."""
    frames, _ = dot_grid(captures)
    found = [find_board(frame, Board("circles", 10, 10, 25.4)) for frame in frames]
    assert [len(points.uv) for points in found].count(100) >= 14
    assert max(np.median(points.sigma) for points in found if len(points.uv)) < 0.1
    assert not any(len(find_board(frame, Board("circles", 9, 10, 25.4)).uv) for frame in frames[:3])
