import struct

import numpy as np
import pytest

from imgcal.watch.c3d_file import C3DFile

c3d = pytest.importorskip("c3d", reason="no c3d (extra dev): no independent reader of C3D")
ezc3d = pytest.importorskip("ezc3d", reason="no ezc3d (extra dev): no independent reader of C3D")


pytestmark = pytest.mark.filterwarnings("ignore:No analog data found:UserWarning")  # of c3d: there is none


def some(frames, markers, seed=0):
    random = np.random.default_rng(seed)
    points = random.uniform(-900, 900, (frames, markers, 3))
    points[random.random((frames, markers)) < 0.3] = np.nan
    return points, random.uniform(0.01, 0.3, (frames, markers)), random.integers(0, 1 << 9, (frames, markers))


def read(path):
    found = ezc3d.c3d(str(path))
    return found, found["data"]["points"][:3].transpose(2, 1, 0), found["data"]["meta_points"]["residuals"][0].T


def read_by_another(path):
    with open(path, "rb") as opened:
        reader = c3d.Reader(opened)
        rows = np.stack([frame for _, frame, _ in reader.read_frames()])
    return reader, rows


@pytest.mark.parametrize("markers", [1, 8, 437])
def test_independent_readers_find_the_points_and_which_are_missing(tmp_path, markers):
    path, names = tmp_path / "trial.c3d", [f"M{number}" for number in range(markers)]
    points, error, cameras = some(50, markers)
    file = C3DFile(path, names, 59.94, 3200.0)
    for part in (slice(0, 1), slice(1, 40), slice(40, 50)):
        file.append(points[part], error[part], cameras[part])
    file.close()
    missing = np.isnan(points).any(-1)
    found, there, residual = read(path)
    point = found["parameters"]["POINT"]
    assert point["RATE"]["value"][0] == pytest.approx(59.94) and point["FRAMES"]["value"][0] == 50
    labels = [name for key in ("LABELS", "LABELS2") if key in point for name in point[key]["value"]]
    assert labels == names and found["header"]["points"]["last_frame"] == 49 and point["UNITS"]["value"] == ["mm"]
    assert np.isnan(there[missing]).all() and (residual[missing] == -1).all()
    assert np.allclose(there[~missing], points[~missing], atol=1e-4)
    reader, rows = read_by_another(path)
    assert [label.strip() for label in reader.point_labels][:255] == names[:255] and len(rows) == 50
    assert (rows[missing][:, 3] == -1).all() and np.allclose(rows[~missing][:, :3], points[~missing], atol=1e-4)
    assert path.stat().st_size % 512 == 0


def test_residual_and_cameras_stand_where_the_format_has_them(tmp_path):
    """Cameras in the high byte, residual in units of POINT:SCALE in the low one (c3d.org); ezc3d has them reversed."""
    path = tmp_path / "trial.c3d"
    points, error, cameras = some(40, 5)
    file = C3DFile(path, list("abcde"), 100.0, 3200.0)
    file.append(points, error, cameras)
    file.close()
    seen = ~np.isnan(points).any(-1)
    _, rows = read_by_another(path)
    fourth = np.frombuffer(path.read_bytes(), "<f4", 4 * 200, 2 * 512).reshape(40, 5, 4)[..., 3].astype(int)
    assert (fourth[seen] >> 8 == cameras[seen] & 127).all() and (fourth[~seen] == -1).all()
    residual = 0.1 * (fourth[seen] & 255)
    assert (residual >= error[seen] - 1e-6).all() and (residual - error[seen] <= 0.1001).all()
    assert np.allclose(rows[seen][:, 3], residual, atol=1e-5)
    assert (rows[seen][:, 4] == cameras[seen] & 127).all()


def test_what_a_killed_process_left_can_be_read(tmp_path):
    path = tmp_path / "trial.c3d"
    points, error, cameras = some(20, 4)
    file = C3DFile(path, list("abcd"), 100.0, 1000.0)
    file.append(points[:9], error[:9], cameras[:9])
    content = path.read_bytes()  # as it lies on the disk, nothing closed
    (tmp_path / "killed.c3d").write_bytes(content)
    _, there, _ = read(tmp_path / "killed.c3d")
    assert np.allclose(there, points[:9], atol=1e-4, equal_nan=True)
    assert struct.unpack_from("<H", content, 8) == (9,)
    file.close()


@pytest.mark.parametrize("frames", [65_535, 65_541, 140_001])
def test_frames_beyond_sixteen_bits_are_written_and_counted(tmp_path, frames):
    path = tmp_path / "long.c3d"
    points = np.zeros((frames, 1, 3))
    points[:, 0, 0] = np.arange(frames)
    file = C3DFile(path, ["a"], 100.0, 1000.0)
    for first in range(0, frames, 65_000):
        part = points[first : first + 65_000]
        file.append(part, np.full(part.shape[:2], 0.1), np.ones(part.shape[:2], dtype=np.int64))
    file.widen(["a", "b"])
    file.close()
    found, there, _ = read(path)
    with open(path, "rb") as opened:
        assert c3d.Reader(opened).last_frame == frames
    assert (there[:frames, 0, 0] == np.arange(frames)).all()
    assert np.isnan(there[frames:]).all() and len(there) < frames + 512 / 32
    assert found["parameters"]["POINT"]["LONG_FRAMES"]["value"][0] == frames


def test_an_existing_file_is_left(tmp_path):
    C3DFile(tmp_path / "trial.c3d", ["a"], 100.0, 1000.0).close()
    with pytest.raises(FileExistsError):
        C3DFile(tmp_path / "trial.c3d", ["a"], 100.0, 1000.0)
