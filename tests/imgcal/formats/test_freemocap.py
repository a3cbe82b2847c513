import tomllib
from pathlib import Path

import numpy as np

from imgcal.formats import convert_rig, read_foreign_rig
from tests.imgcal.formats.rigs import apart, brown, put, put_files, read_in_mm, rig_of
from tests.imgcal.formats.test_anipose import TEXT

WORLD = TEXT.replace("translation", "world_position = [9.0, 9.0, 9.0]\ntranslation").replace(
    "error = 0.6", "groundplane_applied = true"
)


def test_the_pose_is_not_that_of_the_world_keys(tmp_path: Path) -> None:
    rig = read_foreign_rig(put(tmp_path, a__toml=WORLD) / "a.toml")
    assert (rig.format, rig.unit, rig.frame) == ("freemocap", "mm", "the board on the ground")
    assert rig.cameras[1].translation.tolist() == [-200.0, 0.0, 10.0]


def test_written_and_read(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02, 0.001), brown(), names=("0", "1"))
    path = put_files(tmp_path, convert_rig(rig, "freemocap", "x").files)
    table = tomllib.loads(path.read_text())["1"]
    assert np.allclose(table["world_position"], rig.cameras[1].centre)
    assert np.allclose(table["world_orientation"], rig.cameras[1].rotation.T)
    assert apart(rig, read_in_mm(path)) < 1e-8
