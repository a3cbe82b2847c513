from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig
from imgcal.formats.file_storage import storage_text
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import apart, brown, put, put_files, read_in_mm, rig_of

K = np.array([[900.5, 0, 640], [0, 905, 400], [0, 0, 1.0]])
TURN = np.array([[0.1], [0.2], [0.3]])
R = rotation_from_vector(TURN[:, 0])


def files(
    intri: tuple[str, ...] = ("01", "10", "2"), extri: tuple[str, ...] = ("01", "2", "9"), rot: bool = True
) -> dict[str, bytes]:
    inside: dict[str, object] = {"names": list(intri)}
    outside: dict[str, object] = {"names": list(extri)}
    for name in intri:
        inside |= {f"K_{name}": K, f"dist_{name}": np.array([[-0.1, 0.02, 0, 0, 0.0]])}
    for place, name in enumerate(extri):
        outside |= {f"R_{name}": TURN, f"T_{name}": np.array([[0.1], [0.2], [3.0 + place]])} | (
            {f"Rot_{name}": R} if rot else {}
        )
    return {"intri__yml": storage_text(inside), "extri__yml": storage_text(outside)}


@pytest.mark.parametrize("rot", [True, False])
def test_what_is_in_both_files(tmp_path: Path, rot: bool) -> None:
    folder = put(tmp_path, **files(rot=rot))
    for given in (folder, folder / "extri.yml", folder / "intri.yml"):
        rig = read_foreign_rig(given)
        assert (rig.format, rig.unit, rig.names) == ("easymocap", "m", ["01", "2"])
        assert any("cameras 10, 9: left out, not in both files" in note for note in rig.notes)
        assert np.allclose(rig.cameras[0].rotation, R)
        assert rig.cameras[0].image_size is None


def test_cameras_without_a_list_of_names_come_in_natural_order(tmp_path: Path) -> None:
    names = ("10", "2", "cam", "1", "b", "a", "3")
    made = {key: text.replace(b"names", b"other") for key, text in files(names, names).items()}
    assert read_foreign_rig(put(tmp_path, **made)).names == ["1", "2", "3", "10", "a", "b", "cam"]


def test_one_of_two_files(tmp_path: Path) -> None:
    for name, said in (("intri__yml", "found only intri.yml"), ("extri__yml", "found only extri.yml")):
        with pytest.raises(InputError, match=said):
            read_foreign_rig(put(tmp_path / name, **{name: files()[name]}))
    with pytest.raises(InputError, match="no camera is in both"):
        read_foreign_rig(put(tmp_path, **files(("a",), ("b",))))


def test_written_and_read(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02, 0, 0, 0.01), brown())
    back = read_in_mm(put_files(tmp_path / "out", convert_rig(rig, "easymocap", "x").files))
    assert apart(rig, back) < 1e-8
    assert back.cameras[0].image_size == (1280, 960)
