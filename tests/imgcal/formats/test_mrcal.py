from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import brown, put, put_files, read_in_mm, rig_of

TEXT = """
# made by a hand
{{
    'lensmodel': '{model}',
    # fx fy cx cy
    'intrinsics': [900., 901., 640., 400., {ks}],
    '{key}': [0.1, 0.2, 0.3, 1., 2, -3.],
    'imagersize': [1280, 800],
    'optimization_inputs': b'abc{{}}[',
}}
"""


def text(model: str = "LENSMODEL_OPENCV5", ks: str = "-0.1, 0.02, 0, 0, 0.01", key: str = "extrinsics") -> str:
    return TEXT.format(model=model, ks=ks, key=key)


def test_both_names_of_extrinsics(tmp_path: Path) -> None:
    for key in ("extrinsics", "rt_cam_ref"):
        right = text("LENSMODEL_PINHOLE", "").replace("1., 2, -3.", "4., 2, -3.")
        folder = put(tmp_path, left__cameramodel=text(key=key), right__cameramodel=right)
        rig = read_foreign_rig(folder)
        assert (rig.format, rig.unit, rig.names) == ("mrcal", None, ["left", "right"])
        assert np.allclose(rig.cameras[0].rotation, rotation_from_vector(np.array([0.1, 0.2, 0.3])))
        assert rig.cameras[0].translation.tolist() == [1, 2, -3]
    one = read_foreign_rig(folder / "left.cameramodel")
    assert any("their folder" in note for note in one.notes)


@pytest.mark.parametrize(
    ("model", "said"),
    [
        ("LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=30_Ny=20_fov_x_deg=170", "a splined lens"),
        ("LENSMODEL_CAHVORE_linearity=0.3", "a CAHVOR lens"),
        ("LENSMODEL_LATLON", "a panorama"),
        ("LENSMODEL_OPENCV8", "has 12"),
        ("LENSMODEL_NEW", "expected one of"),
    ],
)
def test_what_is_refused(tmp_path: Path, model: str, said: str) -> None:
    with pytest.raises(InputError, match=f"this is a mrcal cameramodel: left: .*{said}"):
        read_foreign_rig(put(tmp_path, left__cameramodel=text(model)))


def test_written_and_read(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02), brown(0, 0, 0, 0, 0, 0.1), brown(), names=("b", "a", "c"))
    folder = put_files(tmp_path / "out", convert_rig(rig, "mrcal", "x").files)
    back = read_in_mm(folder, "m")
    assert back.names == ["a", "b", "c"]  # files come by name
    for camera in rig.cameras:
        other = next(one for one in back.cameras if one.name == camera.name)
        points = np.array([[10.0, 20.0, 900.0]])
        assert np.abs(other.project(points) - camera.project(points)).max() < 1e-8
    assert "OPENCV8" in (folder / "a.cameramodel").read_text()


def test_mrcal_reads_what_is_written(tmp_path: Path) -> None:
    mrcal = pytest.importorskip("mrcal", exc_type=ImportError)
    rig = rig_of(brown(-0.1, 0.02), brown(0, 0, 0, 0, 0, 0.1), brown())
    folder = put_files(tmp_path / "out", convert_rig(rig, "mrcal", "x").files)
    points = np.array([[10.0, 20.0, 900.0], [-100.0, 100.0, 1500.0]])
    for camera in rig.cameras:
        model = mrcal.cameramodel(str(folder / f"{camera.name}.cameramodel"))
        in_camera = mrcal.transform_point_rt(model.extrinsics_rt_fromref(), points / 1000)
        assert np.abs(mrcal.project(in_camera, *model.intrinsics()) - camera.project(points)).max() < 1e-8


def test_a_set_that_was_never_placed(tmp_path: Path) -> None:
    zero = text().replace("[0.1, 0.2, 0.3, 1., 2, -3.]", "[0, 0, 0, 0, 0, 0]")
    with pytest.raises(InputError, match="never calibrated"):
        read_foreign_rig(put(tmp_path, left__cameramodel=zero, right__cameramodel=zero))
