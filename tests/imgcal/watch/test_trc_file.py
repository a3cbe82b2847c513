import numpy as np
import pytest

from imgcal.watch.trc_file import TRCFile
from tests.imgcal.watch.test_c3d_file import some

NAMES = ["LASI", "RASI", "M 3"]


def rows_of(path):
    """The table as its format is described: names in the fourth line, numbers from the seventh."""
    lines = path.read_text().split("\n")
    head = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    names = [name for name in lines[3].split("\t")[2:] if name]
    values = [[np.nan if not cell else float(cell) for cell in line.split("\t")] for line in lines[6:] if line]
    assert lines[5] == ""
    return head, names, np.array(values)


def test_a_table_holds_frames_times_and_points(tmp_path):
    path = tmp_path / "trial.trc"
    points, error, cameras = some(30, 3)
    file = TRCFile(path, NAMES, 120.0)
    for part in (slice(0, 7), slice(7, 30)):
        file.append(points[part], error[part], cameras[part])
        head, names, values = rows_of(path)  # at any moment
        assert int(head["NumFrames"]) == int(head["OrigNumFrames"]) == len(values) == part.stop
    file.close()
    assert (float(head["DataRate"]), head["Units"], int(head["NumMarkers"]), names) == (120.0, "mm", 3, NAMES)
    assert np.allclose(values[:, 0], np.arange(1, 31)) and np.allclose(values[:, 1], np.arange(30) / 120, atol=1e-6)
    assert np.allclose(values[:, 2:].reshape(30, 3, 3), points, atol=1e-5, equal_nan=True)


def test_an_independent_reader_finds_the_same(tmp_path):
    """It splits rows at any white space, so that it can only be asked for markers that are never missing."""
    trc = pytest.importorskip("trc", reason="no trc-data-reader (extra dev): no independent reader of TRC")
    path = tmp_path / "trial.trc"
    points, error, cameras = some(30, 3)
    points = np.nan_to_num(points)
    file = TRCFile(path, ["LASI", "RASI", "M3"], 120.0)
    file.append(points, error, cameras)
    file.close()
    found = trc.TRCData()
    found.load(str(path))
    assert (found["NumFrames"], found["NumMarkers"], found["Units"], found["DataRate"]) == (30, 3, "mm", 120.0)
    for number, name in enumerate(("LASI", "RASI", "M3")):
        assert np.allclose(np.array(found[name], dtype=float), points[:, number], atol=1e-5)
