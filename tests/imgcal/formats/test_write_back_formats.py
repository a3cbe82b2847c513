"""Every format that can be written: a drift of the rig goes back into its files."""

import re
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError, RefusedError
from imgcal.formats import (
    FORMATS,
    ForeignRig,
    convert_rig,
    fit_to_target,
    from_camera_rig,
    select_cameras,
    to_camera_rig,
    write_into,
)
from imgcal.formats.conversion import NATIVE
from tests.imgcal.formats.originals import drifted
from tests.imgcal.formats.rigs import apart, brown, put_files, read_in_mm, rig_of
from tests.imgcal.formats.test_write_back import damaged

NOW = datetime(2026, 11, 24, 3, 30, 5)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
LENS = brown(-0.05, 0.02, 1e-4, -2e-4)
WRITABLE = [one for one in FORMATS if one.write is not None]


def write(folder: Path, name: str, few: int) -> Path:
    rig = select_cameras(rig_of(*[LENS] * 4), tuple(f"side{n}" for n in range(few)))
    return put_files(folder, convert_rig(rig, name, "rig", unit="mm" if name == "pymvg" else None).files)


def unit_of(name: str) -> str | None:
    one = next(one for one in FORMATS if one.name == name)
    return None if one.states_unit else "mm" if name == "pymvg" else one.unit


def ours(path: Path, name: str) -> ForeignRig:
    rig = read_in_mm(path, unit_of(name), name)
    rig = replace(rig, cameras=tuple(replace(camera, image_size=(1280, 960)) for camera in rig.cameras))
    return from_camera_rig(to_camera_rig(fit_to_target(rig, NATIVE, "ours").rig, "x"))


def fitted_into(path: Path, name: str, rig: ForeignRig, out: Path) -> None:
    """Write back, and read the result with everything around it."""
    made = write_into(rig, [path], NOW, name=name, unit=unit_of(name))
    back = read_in_mm(put_files(out, made.files if path.is_dir() else {"": next(iter(made.files.values()))}),
                      unit_of(name), name)  # fmt: skip
    back = replace(back, cameras=tuple(replace(camera, image_size=(1280, 960)) for camera in back.cameras))
    loss = made.loss.worst if made.loss is not None else 0.0
    assert made.reread < 1e-3
    assert apart(rig, back) <= 1.2 * loss + made.reread + 1e-6
    for file, content in made.files.items():
        before = ((path / file) if path.is_dir() else path).read_bytes()
        if not file.endswith(".bin"):
            assert NUMBER.sub("#", before.decode("latin-1")) == NUMBER.sub("#", content.decode("latin-1"))
        else:
            assert len(before) == len(content)


@pytest.mark.parametrize("name", [one.name for one in WRITABLE])
def test_a_drift_goes_back(name: str, tmp_path: Path) -> None:
    one = next(one for one in WRITABLE if one.name == name)
    path = write(tmp_path / "original", name, min(4, one.cameras[1]))
    rig = ours(path, name)
    same = write_into(rig, [path], NOW, name=name, unit=unit_of(name))
    assert same.changed == ()
    for file, content in same.files.items():
        assert content == ((path / file) if path.is_dir() else path).read_bytes()
    fitted_into(path, name, drifted(rig), tmp_path / "new")


def test_both_copies_of_a_colmap_model_are_replaced(tmp_path: Path) -> None:
    rig = rig_of(*[replace(LENS, focal_length=(1000.0, 1000.0))] * 3)
    files = convert_rig(rig, "colmap", "rig").files | convert_rig(rig, "colmap-binary", "rig").files
    files["cameras.txt"] = files["cameras.txt"].replace(b"1000.0", b"1000.00")  # as few decimals cost too much
    both = put_files(tmp_path / "both", files)
    new = drifted(ours(both, "colmap"))
    made = write_into(new, [both], NOW, unit="m")
    for suffix in ("txt", "bin"):
        copy = {name: content for name, content in made.files.items() if name.endswith(suffix)}
        assert apart(new, read_in_mm(put_files(tmp_path / suffix, copy), "m")) < 1e-3


@pytest.mark.parametrize("name", [one.name for one in WRITABLE])
def test_damaged_originals(name: str, tmp_path: Path) -> None:
    """One line of error, or a correct result."""
    one = next(one for one in WRITABLE if one.name == name)
    path = write(tmp_path / "original", name, min(2, one.cameras[1]))
    rig = drifted(ours(path, name))
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    generator = np.random.default_rng(1)
    for number in range(6):
        file = files[number % len(files)]
        content = file.read_bytes()
        file.write_bytes(damaged(content, number % 3, generator))
        try:
            fitted_into(path, name, rig, tmp_path / f"new{number}")
        except (InputError, RefusedError) as error:
            assert "\n" not in str(error)
        file.write_bytes(content)
