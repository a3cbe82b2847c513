import struct
from datetime import datetime
from pathlib import Path

import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig, write_into
from tests.imgcal.formats.originals import drifted
from tests.imgcal.formats.rigs import apart, brown, fisheye, put_files, read_in_mm, rig_of


def folder_of(tmp_path: Path, without: str = "") -> Path:
    files = convert_rig(rig_of(brown(-0.1, 0.02), fisheye(0.01), brown(0, 0, 0, 0, 0.01)), "colmap-binary", "x").files
    return put_files(tmp_path / "model", {name: content for name, content in files.items() if name != without})


def test_rigs_and_images(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02), fisheye(0.01), brown(0, 0, 0, 0, 0.01))
    folder = folder_of(tmp_path)
    assert apart(rig, read_in_mm(folder / "cameras.bin", "m")) < 1e-8
    (folder / "rigs.bin").unlink()
    assert apart(rig, read_in_mm(folder, "m")) < 1e-8
    (folder / "images.bin").unlink()
    with pytest.raises(InputError, match="found only intrinsics"):
        read_foreign_rig(folder)


def test_a_copy_as_text_says_the_same(tmp_path: Path) -> None:
    folder, rig = folder_of(tmp_path), rig_of(brown(-0.1, 0.02), fisheye(0.01), brown(0, 0, 0, 0, 0.01))
    put_files(folder, convert_rig(rig, "colmap", "x").files)
    assert apart(rig, read_in_mm(folder, "m")) < 1e-8
    text = (folder / "cameras.txt").read_text()
    (folder / "cameras.txt").write_text(text.replace("1010.5", "1011.5"))
    for name in (None, "colmap-binary"):
        with pytest.raises(InputError, match=r"found a COLMAP model .* beside it with cameras that are [\d.]+ px off"):
            read_foreign_rig(folder, name)
    put_files(folder, convert_rig(rig_of(brown(), brown()), "colmap", "x").files)
    with pytest.raises(InputError, match=r"found a COLMAP model .* beside it with other cameras"):
        read_foreign_rig(folder)
    (folder / "images.bin").unlink()
    (folder / "rigs.bin").unlink()
    with pytest.raises(InputError, match=r"found a COLMAP model .binary. beside it: found only intrinsics"):
        read_foreign_rig(folder)


def test_an_imu_with_the_number_of_a_camera_is_left_alone(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    rigs, imu = (folder / "rigs.bin").read_bytes(), struct.pack("<iIB7d", 1, 3, 1, 1, 0, 0, 0, 5, 6, 7)
    (folder / "rigs.bin").write_bytes(rigs[:12] + struct.pack("<I", 4) + rigs[16:] + imu)
    new = drifted(read_in_mm(folder, "m"))
    made = write_into(new, [folder], datetime(2026, 11, 24), unit="m")
    assert made.files["rigs.bin"].endswith(imu)
    assert made.files["rigs.bin"] != (folder / "rigs.bin").read_bytes()


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "rigs.bin"])
def test_a_file_that_ends_too_early(tmp_path: Path, name: str) -> None:
    folder = folder_of(tmp_path)
    content = (folder / name).read_bytes()
    for cut in range(0, len(content), 7):
        (folder / name).write_bytes(content[:cut])
        with pytest.raises(InputError, match="this is a COLMAP model"):
            read_foreign_rig(folder)


def test_counts_are_compared_with_the_file(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    for name in ("cameras.bin", "images.bin", "rigs.bin"):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(struct.pack("<Q", 2**62) + content[8:])
        with pytest.raises(InputError, match="in the middle of a record"):
            read_foreign_rig(folder)
        (folder / name).write_bytes(content)
    content = (folder / "cameras.bin").read_bytes()
    (folder / "cameras.bin").write_bytes(content[:12] + struct.pack("<i", 99) + content[16:])
    with pytest.raises(InputError, match="model number 99"):
        read_foreign_rig(folder)
