"""Checks before decoding: no test here may need the memory that a header announces."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.io import Video, read_frame
from imgcal.io.frames import count_frames

GREY = np.random.default_rng(0).integers(0, 255, (24, 32)).astype(np.uint8)


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, pixels: bytes, more: bytes = b"", depth: int = 8, colour: int = 0) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + more + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")


def tiff(width: int, height: int, samples: int = 1) -> bytes:
    entries = [(256, width), (257, height), (277, samples), (258, 8), (259, 1), (273, 8), (278, height), (279, 8)]
    tags = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries)
    return struct.pack("<2sHI", b"II", 42, 8) + struct.pack("<H", len(entries)) + tags + struct.pack("<I", 0)


def encoded(suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, GREY)[1])


def announcing(content: bytes, at: int, layout: str, *numbers: int) -> bytes:
    return content[:at] + struct.pack(layout, *numbers) + content[at + struct.calcsize(layout) :]


def forbid_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    for decoder in ("imdecode", "imreadmulti", "VideoCapture"):
        monkeypatch.setattr(cv2, decoder, None)


JPEG_SIZE = encoded(".jpg").index(b"\xff\xc0") + 5

TOO_LARGE = {
    "f.png": png(32_000, 32_000, bytes(100)),
    "g.png": png(2**31 - 1, 2**31 - 1, bytes(100)),
    "f.bmp": announcing(encoded(".bmp"), 18, "<ii", 30_000, -30_000),
    "f.pgm": b"P5\n# made by hand\n32000 32000\n255\n" + bytes(100),
    "f.jpg": announcing(encoded(".jpg"), JPEG_SIZE, ">HH", 60_000, 60_000),
    "f.tif": tiff(32_000, 32_000),
    "g.tif": tiff(8_000, 8_000, 65_535),
}


@pytest.mark.parametrize("name", TOO_LARGE)
def test_a_flood_of_pixels_is_seen_in_the_header(name: str, tmp_path: Path, monkeypatch) -> None:
    forbid_decoding(monkeypatch)
    (tmp_path / name).write_bytes(TOO_LARGE[name])
    with pytest.raises(InputError, match=r"found \d+x\d+ pixels.*, expected at most"):
        read_frame(tmp_path / name)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".pgm", ".jpg", ".tif"])
def test_another_size_is_seen_in_the_header(suffix: str, tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / f"f{suffix}"
    path.write_bytes(encoded(suffix))
    assert read_frame(path, size=(32, 24)).shape == (24, 32)
    forbid_decoding(monkeypatch)
    with pytest.raises(InputError, match="found 32x24 pixels, expected 24x32"):
        read_frame(path, size=(24, 32))


BROKEN = {
    "pixels.png": png(32, 24, b"\0" * 100),
    "filter.png": png(32, 24, (b"\x09" + bytes(32)) * 24),
    "depth.png": png(32, 24, bytes(33 * 24), depth=3),
    "colour.png": png(32, 24, bytes(33 * 24), colour=5),
    "zero.png": png(0, 24, b""),
    "critical.png": png(32, 24, bytes(33 * 24), chunk(b"ABCD", b"")),
    "damaged.jpg": encoded(".jpg")[:200] + b"\0\xff\xdb" * 100,
    "header.jpg": b"\xff\xd8\xff",
    "short.bmp": b"BM" + bytes(10),
    "other.bmp": b"v/1\x01" + bytes(100),
    "other.png": encoded(".jpg"),
    "digits.pgm": b"P5 99999999999999999999 1 255\n",
    "empty.pgm": b"P5 ",
    "offset.tif": struct.pack("<2sHHHQ", b"II", 43, 8, 0, 2**64 - 1),
    "entries.tif": struct.pack("<2sHHHQ", b"II", 43, 8, 0, 16) + struct.pack("<QQ", 2**63, 0),
    "far.tif": struct.pack("<2sHI", b"II", 42, 2**32 - 1),
    "noise.tif": struct.pack("<2sHI", b"II", 42, 8) + bytes(range(200)),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_images_are_one_error_and_nobody_else_prints(name: str, tmp_path: Path, capfd) -> None:
    (tmp_path / name).write_bytes(BROKEN[name])
    with pytest.raises(InputError) as caught:
        read_frame(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: found ") and "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "more",
    [
        chunk(b"iCCP", b"x\0\0junk"),
        chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(1000))),
        chunk(b"acTL", struct.pack(">II", 10**6, 0)),
    ],
)
def test_what_does_not_belong_to_the_pixels_is_not_looked_at(more: bytes, tmp_path: Path, capfd) -> None:
    pixels = b"".join(b"\0" + row.tobytes() for row in GREY)
    (tmp_path / "f.png").write_bytes(png(32, 24, pixels + b"more than there is room for", more))
    np.testing.assert_array_equal(read_frame(tmp_path / "f.png"), GREY)
    assert capfd.readouterr().err == ""


def test_a_tiff_whose_pages_lead_in_a_circle_is_read_once(tmp_path: Path) -> None:
    content = tiff(32, 24)
    (tmp_path / "f.tif").write_bytes(content[:-4] + struct.pack("<I", 8))
    assert count_frames(tmp_path / "f.tif") == 1


def test_a_video_that_announces_more_frames_than_bytes(tmp_path: Path, capfd) -> None:
    path = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (32, 24), False)
    for _ in range(3):
        writer.write(GREY)
    writer.release()
    content = path.read_bytes()
    stream = content.index(b"strh") + 8
    content = announcing(content, content.index(b"avih") + 8 + 16, "<I", 2**31 - 1)
    path.write_bytes(announcing(content, stream + 32, "<I", 2**31 - 1))
    with pytest.raises(InputError, match=r"found 2,147,483,647 frames announced in [\d,]+ bytes|damaged"):
        count_frames(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "content", [b"#EXTM3U\n#EXTINF:1,\nfile:///etc/hostname\n", b"ffconcat version 1.0\nfile x.avi\n"]
)
@pytest.mark.parametrize("suffix", [".avi", ".mp4", ".mkv", ".mov"])
def test_a_list_of_other_files_is_no_video(content: bytes, suffix: str, tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / f"v{suffix}"
    path.write_bytes(content)
    forbid_decoding(monkeypatch)
    with pytest.raises(InputError, match="found a damaged or empty file, expected a video"):
        Video(path)
