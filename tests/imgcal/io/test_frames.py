import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from imgcal.errors import InputError
from imgcal.io import Video, read_frame, write_frame
from imgcal.io.frames import count_frames

RNG = np.random.default_rng(0)
GREY8 = RNG.integers(0, 256, (48, 64)).astype(np.uint8)
GREY16 = RNG.integers(0, 65536, (48, 64)).astype(np.uint16)


def write_video(path: Path, count: int, codec: str = "FFV1") -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10, (64, 48), False)
    assert writer.isOpened()
    for level in range(count):
        writer.write(np.full((48, 64), 10 * level, np.uint8))
    writer.release()


@settings(max_examples=30, deadline=None)
@given(hnp.arrays(st.sampled_from([np.uint8, np.uint16]), st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_png_round_trip_is_exact(tmp_path_factory: pytest.TempPathFactory, frame: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "f.png"
    write_frame(path, frame)
    np.testing.assert_array_equal(read_frame(str(path)), frame, strict=True)


@pytest.mark.parametrize("frame", [GREY8, GREY16], ids=["8 bit", "16 bit"])
@pytest.mark.parametrize("compression", [1, 5, 8])
def test_tiff_pages(frame: Any, compression: int, tmp_path: Path) -> None:
    path = tmp_path / "f.tif"
    pages = [frame, frame[::-1], frame // 2]
    assert cv2.imwritemulti(str(path), pages, [cv2.IMWRITE_TIFF_COMPRESSION, compression])
    assert count_frames(path) == 3
    for index, page in enumerate(pages):
        np.testing.assert_array_equal(read_frame(path, index), page, strict=True)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".jpg"])
def test_equal_channels_are_grey(suffix: str, tmp_path: Path) -> None:
    smooth = np.tile(np.arange(64, dtype=np.uint8), (48, 1))
    cv2.imwrite(str(tmp_path / f"f{suffix}"), np.dstack([smooth] * 3))
    frame = read_frame(tmp_path / f"f{suffix}")
    assert frame.shape == (48, 64)
    assert np.abs(frame.astype(int) - smooth).max() <= (4 if suffix == ".jpg" else 0)


def test_opaque_alpha_is_dropped(tmp_path: Path) -> None:
    image = np.dstack([GREY16] * 3 + [np.full_like(GREY16, 65535)])
    cv2.imwrite(str(tmp_path / "f.png"), image)
    np.testing.assert_array_equal(read_frame(tmp_path / "f.png"), GREY16, strict=True)
    image[0, 0, 3] = 7
    cv2.imwrite(str(tmp_path / "f.png"), image)
    with pytest.raises(InputError, match="transparent"):
        read_frame(tmp_path / "f.png")


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".bmp", ".pgm"])
@pytest.mark.parametrize("kept", [0.0, 0.02, 0.5, 0.9])
def test_truncated_image(suffix: str, kept: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"f{suffix}"
    cv2.imwrite(str(path), GREY8)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InputError) as caught:
        read_frame(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("missing", [1, 4, 12, 13, 200])
def test_png_without_its_end_is_truncated(missing: int, tmp_path: Path) -> None:
    path = tmp_path / "f.png"
    write_frame(path, GREY16)
    path.write_bytes(path.read_bytes()[:-missing])
    with pytest.raises(InputError, match=r"found a truncated PNG of \d+ bytes"):
        read_frame(path)


def test_flipped_bit_in_png(tmp_path: Path) -> None:
    path = tmp_path / "f.png"
    write_frame(path, GREY16)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="found a damaged PNG"):
        read_frame(path)


def test_truncated_pages_are_not_lost_silently(tmp_path: Path) -> None:
    path = tmp_path / "f.tif"
    cv2.imwritemulti(str(path), [GREY16] * 3, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="found a truncated TIFF"):
        count_frames(path)


def test_wart_opencv_reads_the_first_pages_of_a_truncated_tiff(tmp_path: Path) -> None:
    path = tmp_path / "f.tif"
    cv2.imwritemulti(str(path), [GREY16] * 3, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert cv2.imcount(str(path)) < 3


def test_big_tiff_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "f.tif"
    # Header with an offset to an empty directory, which has no next one.
    path.write_bytes(struct.pack("<2sHHHQ", b"II", 43, 8, 0, 16) + struct.pack("<QQ", 0, 0))
    assert count_frames(path) == 1


@pytest.mark.parametrize(
    ("name", "image", "message"),
    [
        ("f.tif", np.zeros((4, 5), np.float32), "found pixels of type float32, expected 8 or 16 bit"),
        ("f.tif", np.zeros((4, 5), np.int16), "found pixels of type int16"),
        ("f.png", np.dstack([GREY8, GREY8, GREY8 // 2]), "found a colour image"),
    ],
)
def test_unusable_pixels(name: str, image: Any, message: str, tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / name), image)
    with pytest.raises(InputError, match=message):
        read_frame(tmp_path / name)


@pytest.mark.parametrize("name", ["f.png", "f.tif", "f.bmp", "f.jpg"])
def test_junk_and_missing_files(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"{name}: cannot be read: No such file"):
        read_frame(tmp_path / name)
    (tmp_path / name).write_bytes(b"hello, this is no image" * 20)
    with pytest.raises(InputError, match=rf"{name}: found a"):
        read_frame(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "frame"),
    [("f.jpg", GREY8), ("f.png", GREY8.astype(float)), ("f.png", GREY8[0]), ("f.png", GREY8[:0])],
)
def test_write_frame_refuses(name: str, frame: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=name):
        write_frame(tmp_path / name, frame)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "codec"), [("v.avi", "FFV1"), ("v.avi", "MJPG"), ("v.mp4", "mp4v")])
def test_video(name: str, codec: str, tmp_path: Path) -> None:
    write_video(tmp_path / name, 5, codec)
    assert count_frames(tmp_path / name) == 5
    with Video(tmp_path / name) as video:
        for index in (0, 1, 4):
            frame = video.read(index)
            assert frame.shape == (48, 64)
            assert abs(float(frame.mean()) - 10 * index) <= 2
        with pytest.raises(ValueError, match="forwards"):
            video.read(2)


def test_truncated_video(tmp_path: Path) -> None:
    path = tmp_path / "v.avi"
    write_video(path, 9, "MJPG")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"v\.avi: found"), Video(path) as video:
        for index in range(9):
            video.read(index)


def test_junk_video(tmp_path: Path) -> None:
    (tmp_path / "v.avi").write_bytes(b"junk" * 100)
    with pytest.raises(InputError, match=r"v\.avi: found a damaged or empty file"):
        count_frames(tmp_path / "v.avi")


def tiff_of(frame: Any, orientation: int = 1, white_is_zero: bool = False) -> bytes:
    """Write one uncompressed grey page by hand."""
    (rows, columns), bits = frame.shape, 8 * frame.itemsize
    tags = {256: columns, 257: rows, 258: bits, 259: 1, 262: 0 if white_is_zero else 1, 273: 0, 274: orientation}
    tags |= {277: 1, 278: rows, 279: frame.nbytes}
    tags[273] = start = 8 + 2 + 12 * len(tags) + 4
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    head = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)
    assert len(head) == start
    return head + frame.astype(frame.dtype.newbyteorder("<")).tobytes()


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("frame", [GREY8, GREY16], ids=["8 bit", "16 bit"])
def test_pixels_are_those_of_the_file_however_it_is_turned_for_display(
    frame: Any, orientation: int, tmp_path: Path
) -> None:
    path = tmp_path / "f.tif"
    path.write_bytes(tiff_of(frame, orientation))
    np.testing.assert_array_equal(read_frame(path, size=(64, 48)), frame, strict=True)
    if orientation > 1:  # wart: OpenCV turns TIFF, whatever its flags
        assert not np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), frame)
    if frame.dtype == np.uint8:
        plain = cv2.imencode(".jpg", frame)[1].tobytes()
        exif = b"Exif\0\0II*\0" + struct.pack("<IHHHIII", 8, 1, 274, 3, 1, orientation, 0)
        (tmp_path / "plain.jpg").write_bytes(plain)
        turned = tmp_path / "turned.jpg"
        turned.write_bytes(plain[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + plain[2:])
        np.testing.assert_array_equal(read_frame(turned), read_frame(tmp_path / "plain.jpg"), strict=True)


def test_inverted_grey_values_are_read_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "f.tif"
    path.write_bytes(tiff_of(255 - GREY8, white_is_zero=True))
    np.testing.assert_array_equal(read_frame(path), GREY8, strict=True)
    path = tmp_path / "g.tif"
    path.write_bytes(tiff_of(65535 - GREY16, white_is_zero=True))
    with pytest.raises(InputError, match="inverted grey values"):
        read_frame(path)
    assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[0, 0] == 65535 - GREY16[0, 0]  # wart: OpenCV inverts 8 bit only
