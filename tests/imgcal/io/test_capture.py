import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from imgcal.errors import InputError
from imgcal.geometry import RigidTransform
from imgcal.io import Capture, Frame, data_path, open_capture, open_input, save_capture_settings, write_frame
from imgcal.types import CameraRig, Detections


def make_rig(*names: str) -> CameraRig:
    count = len(names)
    return CameraRig(
        focal_length=torch.full((count, 2), 100.0),
        principal_point=torch.zeros(count, 2),
        distortion=torch.zeros(count, 5),
        cam_from_rig=RigidTransform.identity(count),
        image_size=torch.tensor([[32, 24]] * count),
        camera_names=names,
    )


def grey(level: int = 0, dtype: type = np.uint8) -> Frame:
    return np.full((24, 32), level, dtype)


def put(folder: Path, name: str, frame: Frame | None = None) -> None:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    write_frame(path, grey() if frame is None else frame)


def levels(capture: Capture) -> dict[str, list[int | None]]:
    """First grey value of every camera's frame, by snapshot."""
    return {
        snapshot: [None if frame is None else int(frame[0, 0]) for frame in frames.values()]
        for snapshot, frames in capture.snapshots()
    }


def test_folders_with_missing_frames_and_a_missing_camera(tmp_path: Path) -> None:
    for snapshot in (2, 10):
        put(tmp_path, f"frames/left/{snapshot}.png", grey(snapshot))
    put(tmp_path, "frames/right/10.png", grey(100))
    put(tmp_path, "frames/right/1.png", grey(101))
    (tmp_path / "frames" / ".DS_Store").write_bytes(b"x")
    capture = open_capture(tmp_path, make_rig("right", "left", "dark"))
    assert capture.camera_names == ("right", "left", "dark")
    assert capture.snapshot_names == ("1", "2", "10")
    assert levels(capture) == {"1": [101, None, None], "2": [None, 2, None], "10": [100, 10, None]}
    assert [name for name, _ in capture.snapshots(1, 2)] == ["2"]
    assert [name for name, _ in capture.snapshots(1)] == ["2", "10"]
    assert open_capture(tmp_path).camera_names == ("left", "right")


def test_a_camera_s_name_in_its_files_is_not_part_of_the_snapshot_s(tmp_path: Path) -> None:
    for number in (1, 2):
        put(tmp_path, f"frames/cam1/cam1_{number:03}.png", grey(number))
        put(tmp_path, f"frames/cam2/{number:03}-Cam2.png", grey(10 + number))
        put(tmp_path, f"frames/cam3/{number:03}.png", grey(20 + number))
    capture = open_capture(tmp_path, make_rig("cam1", "cam2", "cam3"))
    assert levels(capture) == {"001": [1, 11, 21], "002": [2, 12, 22]}


def test_frames_that_share_no_name_are_an_error_that_shows_the_names(tmp_path: Path) -> None:
    for number in (1, 2):
        put(tmp_path, f"frames/cam1/{number:03}.png")
        put(tmp_path, f"frames/cam2/{number:03}.png")
        put(tmp_path, f"frames/cam3/{number}.png")
    message = r"frames/cam3: found 1, 2, of which no other camera has one \(cam1: 001, 002\), expected frames of one"
    with pytest.raises(InputError, match=message):
        open_capture(tmp_path, make_rig("cam1", "cam2", "cam3"))
    assert open_capture(tmp_path, make_rig("cam1", "cam2"), without=("cam3",)).snapshot_names == ("001", "002")
    assert len(open_capture(tmp_path).snapshot_names) == 4  # to look at single cameras


def test_files_that_systems_leave_behind_are_no_frames(tmp_path: Path) -> None:
    put(tmp_path, "frames/a/0.png")
    for name in ("Thumbs.db", "frames/desktop.ini", "frames/a/Thumbs.db"):
        (tmp_path / name).write_bytes(b"x")
    assert open_capture(tmp_path, make_rig("a")).snapshot_names == ("0",)


def test_frames_by_camera_are_those_of_the_snapshots(tmp_path: Path) -> None:
    capture = open_capture(data_path("samples", "O10"))
    frames = capture.frames(1, 3)
    assert list(frames) == list(capture.camera_names) and {len(series) for series in frames.values()} == {2}
    for number, (_, snapshot) in enumerate(capture.snapshots(1, 3)):
        assert all(np.array_equal(frames[name][number], frame) for name, frame in snapshot.items())


def test_one_file_a_camera(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    cv2.imwritemulti(str(tmp_path / "frames" / "a.tif"), [grey(i, np.uint16) for i in range(12)])
    writer = cv2.VideoWriter(str(tmp_path / "frames" / "b.avi"), cv2.VideoWriter.fourcc(*"FFV1"), 10, (32, 24), False)
    for i in range(11):
        writer.write(grey(20 + i))
    writer.release()
    put(tmp_path, "frames/c.png", grey(99))
    with pytest.raises(InputError, match=r"b\.avi: found 11 frames, and 12 in a\.tif, expected as many"):
        open_capture(tmp_path, make_rig("a", "b", "c"))
    capture = open_capture(tmp_path, make_rig("a", "b", "c"), videos_differ=True)
    assert capture.snapshot_names == tuple(str(i) for i in range(12))
    seen = levels(capture)
    assert seen["0"] == [0, 20, 99]
    assert seen["10"] == [10, 30, None]
    assert seen["11"] == [11, None, None]
    assert [int(f["b"][0, 0]) for _, f in capture.snapshots(3, 5) if f["b"] is not None] == [23, 24]


def write_video(path: Path, levels: list[int], rate: float = 10.0, codec: str = "FFV1") -> None:
    path.parent.mkdir(exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate, (32, 24), False)
    for level in levels:
        writer.write(grey(level))
    writer.release()


def test_a_video_that_lacks_a_frame_is_an_error_unless_told_otherwise(tmp_path: Path) -> None:
    write_video(tmp_path / "frames" / "a.avi", [0, 1, 2, 3])
    write_video(tmp_path / "frames" / "b.avi", [0, 2, 3])
    with pytest.raises(InputError, match=r"b\.avi: found 3 frames, and 4 in a\.avi.*--videos-differ"):
        open_input(tmp_path)
    capture = open_input(tmp_path, videos_differ=True)
    assert isinstance(capture, Capture) and levels(capture)["2"] == [2, 3]


def test_videos_whose_time_stamps_differ_are_an_error_unless_told_otherwise(tmp_path: Path) -> None:
    write_video(tmp_path / "frames" / "a.mkv", list(range(8)), 10.0)
    write_video(tmp_path / "frames" / "b.mkv", list(range(8)), 11.0)
    with pytest.raises(InputError, match=r"a\.mkv: found frame 6 at 0\.600 s, in b\.mkv at 0\.545 s"):
        list(open_capture(tmp_path).snapshots())
    assert levels(open_capture(tmp_path, videos_differ=True))["7"] == [7, 7]


@pytest.mark.parametrize("name", [b"frames/a/\xff.png", b"frames/\xff/0.png", b"frames/a/0\x1b[31m.png"])
def test_names_that_are_no_text(name: bytes, tmp_path: Path) -> None:
    put(tmp_path, "frames/a/1.png")
    path = tmp_path / os.fsdecode(name)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes((tmp_path / "frames/a/1.png").read_bytes())
    with pytest.raises(InputError, match="a name that is not valid text"):
        open_capture(tmp_path)


def test_a_pipe_is_no_input(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(InputError, match="device or pipe"):
        open_input(tmp_path / "pipe.csv")


@pytest.mark.parametrize(
    "name", ["capture.yaml", "frames/a/2.png", "frames/a/2.tif", "frames/b.tif", "frames/b.avi", "masks/a.png"]
)
def test_a_pipe_in_a_capture_is_not_waited_for(name: str, tmp_path: Path) -> None:
    put(tmp_path, "frames/a/1.png")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: found a folder, device or pipe"):
        capture = open_capture(tmp_path)
        capture.mask("a")
        list(capture.snapshots())


def test_masks_are_a_folder(tmp_path: Path) -> None:
    put(tmp_path, "frames/a/1.png")
    (tmp_path / "masks").write_text("x")
    with pytest.raises(InputError, match="masks: found a file, expected a folder"):
        open_capture(tmp_path)


def test_frames_are_read_only_when_asked_for(tmp_path: Path) -> None:
    put(tmp_path, "frames/a/0.png")
    put(tmp_path, "frames/a/1.png")
    (tmp_path / "frames/a/1.png").write_bytes(b"")
    snapshots = open_capture(tmp_path).snapshots()
    assert next(snapshots)[0] == "0"
    with pytest.raises(InputError, match=r"1\.png: found an empty file"):
        next(snapshots)


def test_masks(tmp_path: Path) -> None:
    put(tmp_path, "frames/a/0.png")
    mask = grey()
    mask[3, 4] = 1
    put(tmp_path, "masks/a.png", mask)
    capture = open_capture(tmp_path, make_rig("a", "b"))
    found = capture.mask("a")
    assert found is not None
    assert found.dtype == np.bool_
    assert np.argwhere(found).tolist() == [[3, 4]]
    assert capture.mask("b") is None
    put(tmp_path, "masks/a.png", mask[:, :30])
    with pytest.raises(InputError, match=r"a\.png: found 30x24 pixels, expected 32x24"):
        capture.mask("a")
    (tmp_path / "masks/a.png").rename(tmp_path / "masks/a.PNG")
    put(tmp_path, "masks/b.png", mask)
    capture = open_capture(tmp_path, make_rig("a", "b"))
    assert capture.mask("b") is not None
    with pytest.raises(InputError, match=r"a\.PNG: found 30x24 pixels, expected 32x24"):
        capture.mask("a")
    put(tmp_path, "masks/b.PNG", mask)
    with pytest.raises(InputError, match=r"masks: found b\.PNG and b\.png, expected one mask of camera b"):
        open_capture(tmp_path, make_rig("a", "b"))
    (tmp_path / "masks/b.PNG").unlink()
    put(tmp_path, "masks/c.png", mask)
    with pytest.raises(InputError, match=r"c\.png: expected masks named <camera name>\.png, cameras: a, b"):
        open_capture(tmp_path, make_rig("a", "b"))


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_settings(bits: int, tmp_path: Path) -> None:
    put(tmp_path, "frames/a/0.png", grey(200, np.uint8 if bits == 8 else np.uint16))
    assert open_capture(tmp_path).bit_depth is None
    save_capture_settings(tmp_path, bits, note="made: for a test")
    capture = open_capture(tmp_path)
    assert capture.bit_depth == bits
    assert levels(capture) == {"0": [200]}


def test_settings_that_could_not_be_read_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"capture\.yaml: not written: bit_depth: found 10, expected 8, 12 or 16"):
        save_capture_settings(tmp_path, 10)
    assert not list(tmp_path.iterdir())


def _colour(folder: Path) -> None:
    cv2.imwrite(str(folder / "frames/a/0.png"), np.dstack([grey(1), grey(2), grey(3)]))


def _mixed(folder: Path) -> None:
    put(folder, "frames/a/0.png", grey(0, np.uint16))
    put(folder, "frames/a/1.png", grey())


def _pages(folder: Path) -> None:
    cv2.imwritemulti(str(folder / "frames/a/2.tif"), [grey(), grey()])


def _settings(bits: int) -> Callable[[Path], None]:
    return lambda folder: save_capture_settings(folder, bits)


def _put(name: str, frame: Frame | None = None) -> Callable[[Path], None]:
    return lambda folder: put(folder, name, frame)


def _write(name: str, text: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / name).write_text(text)

    return write


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_put("frames/cam3/0.png"), r"frames: found cam3, expected the cameras of rig rig: a, b"),
        (_put("frames/a.png"), r"frames: found camera a more than once"),
        (_put("frames/b/0.png", grey()[:, :-1]), r"b/0\.png: found 31x24 pixels, expected 32x24"),
        (_put("frames/a/1.png", grey(0, np.uint16)), r"a/1\.png: found 16-bit pixels, expected 8 bit as in the first"),
        (_mixed, r"a/1\.png: found a 16-bit frame saved as 8-bit, expected 16 bit as in the first frame of a"),
        (_settings(16), r"a/0\.png: found a 16-bit frame saved as 8-bit, expected 16 bit as stated in capture\.yaml"),
        (_settings(12), r"a/0\.png: found a 12-bit frame saved as 8-bit"),
        (
            _write("capture.yaml", "format: imgcal-capture/1\nbit_depth: 10\n"),
            r"capture\.yaml: bit_depth: found 10, expected 8, 12 or 16",
        ),
        (
            _write("capture.yaml", "format: imgcal-capture/1\nbit_depht: 8\n"),
            r"unknown key `bit_depht`, nearest: bit_depth",
        ),
        (_write("capture.yaml", "bit_depth: 8\n"), r"capture\.yaml: found no key `format`"),
        (_colour, r"a/0\.png: found a colour image"),
        (_pages, r"a/2\.tif: found 2 pages, expected 1"),
        (_write("frames/a/0.tif", "x"), r"found snapshot 0 more than once, also in 0\.png"),
        (_write("frames/a/notes.txt", "x"), r"notes\.txt: expected an image of one snapshot"),
        (_write("frames/notes.txt", "x"), r"notes\.txt: expected a folder, an image or a video"),
    ],
)
def test_bad_captures_give_one_clear_line(spoil: Callable[[Path], None], message: str, tmp_path: Path) -> None:
    put(tmp_path, "frames/a/0.png")
    spoil(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        list(open_capture(tmp_path, make_rig("a", "b")).snapshots())
    assert str(caught.value).startswith(str(tmp_path))
    assert "\n" not in str(caught.value)


def test_sizes_must_agree_without_a_rig(tmp_path: Path) -> None:
    put(tmp_path, "frames/a/0.png")
    put(tmp_path, "frames/a/1.png", grey()[1:])
    with pytest.raises(InputError, match=r"1\.png: found 32x23 pixels, expected 32x24"):
        list(open_capture(tmp_path).snapshots())


def test_twelve_bits_are_the_low_ones(tmp_path: Path) -> None:
    put(tmp_path, "frames/a/0.png", grey(4096, np.uint16))
    save_capture_settings(tmp_path, 12)
    with pytest.raises(InputError, match=r"0\.png: found the value 4096, expected at most 4095"):
        list(open_capture(tmp_path).snapshots())


def test_open_input(tmp_path: Path) -> None:
    put(tmp_path, "capture/frames/a/0.png")
    assert isinstance(open_input(tmp_path / "capture"), Capture)
    (tmp_path / "d.csv").write_text("snapshot,camera,u,v\n0,a,1,2\n")
    assert isinstance(open_input(tmp_path / "d.csv", make_rig("a")), Detections)


def test_open_input_of_something_else(tmp_path: Path) -> None:
    put(tmp_path, "full/pictures/a.png")
    (tmp_path / "empty").mkdir()
    (tmp_path / "bare" / "frames" / "a").mkdir(parents=True)
    for name, message in (
        ("none", "no such file or folder, expected a capture folder or"),
        ("empty", r"found an empty folder, expected a capture that holds frames/"),
        ("full", r"found pictures, expected a capture that holds frames/"),
        ("full/pictures/a.png", "found one image or video"),
        ("bare", "found no frames"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            open_input(tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name))


def test_one_camera_is_told_where_its_snapshots_go(tmp_path: Path) -> None:
    put(tmp_path, "frames/00.png")
    with pytest.raises(InputError, match=r"found 00, .*put the snapshots into .*frames/cam01"):
        open_capture(tmp_path, make_rig("cam01"))


@pytest.mark.parametrize(
    ("name", "cameras", "shape"),
    [
        ("three-cameras-dots", ("cam1", "cam2", "cam3"), (1024, 1280)),
        ("cavity-two-cameras", ("cam3", "cam4"), (1024, 1280)),
    ],
)
def test_real_captures(captures: Path, name: str, cameras: tuple[str, ...], shape: tuple[int, int]) -> None:
    capture = open_capture(captures / name)
    assert capture.camera_names == cameras
    ((snapshot, frames),) = capture.snapshots()
    assert snapshot == "0"
    for frame in frames.values():
        assert frame is not None
        assert (frame.shape, frame.dtype) == (shape, np.uint8)


def test_a_camera_that_the_rig_does_not_have_can_be_left_out(tmp_path: Path) -> None:
    rig = make_rig("cam01", "cam02")
    rows = [f"0,{camera},10,5" for camera in (*rig.camera_names, "cam09")]
    (tmp_path / "blobs.csv").write_text("\n".join(["snapshot,camera,u,v", *rows]))
    with pytest.raises(InputError, match=r"line 4: camera: found 'cam09' .*, expected a camera of the rig: cam01"):
        open_input(tmp_path / "blobs.csv", rig)
    found = open_input(tmp_path / "blobs.csv", rig, without=["cam09"])
    assert isinstance(found, Detections)
    assert found.camera_names == rig.camera_names and len(found) == 2
    for camera in (*rig.camera_names, "cam09"):
        path = tmp_path / "capture" / "frames" / camera / "0.png"
        path.parent.mkdir(parents=True)
        write_frame(path, grey())
    with pytest.raises(InputError, match="frames: found cam09, expected the cameras of rig"):
        open_input(tmp_path / "capture", rig)
    capture = open_input(tmp_path / "capture", rig, without=["cam09"])
    assert isinstance(capture, Capture)
    assert capture.camera_names == rig.camera_names
    for source in ("blobs.csv", "capture"):
        with pytest.raises(InputError, match="found no camera cam08 to leave out, neither here nor in the rig"):
            open_input(tmp_path / source, rig, without=["cam09", "cam08"])
