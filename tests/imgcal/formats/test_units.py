import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import in_millimetres, millimetres
from tests.imgcal.formats.rigs import brown, rig_of

RIG = rig_of(brown(), brown(), brown())


def test_units() -> None:
    assert [millimetres(unit) for unit in ("mm", "cm", "m", "inch", "417.2mm", "2 m", "1e-3m")] == [
        1, 10, 1000, 25.4, 417.2, 2000, 1,
    ]  # fmt: skip
    for bad in ("", "miles", "3", "-1mm", "0mm", "1e300m", "nan mm", "mm" * 100):
        with pytest.raises(InputError, match="--unit: found"):
            millimetres(bad)


def test_what_the_file_says_is_not_asked_for() -> None:
    metres = RIG.scale(1e-3, "m")
    assert np.allclose(in_millimetres(metres, "x").cameras[1].translation, RIG.cameras[1].translation)
    assert np.allclose(in_millimetres(metres, "x", "2m").cameras[1].translation, 2 * RIG.cameras[1].translation)


def test_what_it_does_not_say_is_never_guessed() -> None:
    unknown = type(RIG)(RIG.format, RIG.cameras, None, RIG.frame)
    with pytest.raises(InputError, match=r"file.yaml: the file does not state its unit of length"):
        in_millimetres(unknown, "file.yaml")
    alone = type(RIG)(RIG.format, RIG.cameras[:1], None, RIG.frame)
    assert in_millimetres(alone, "x").unit == "mm"  # one camera has no lengths


def test_a_known_distance() -> None:
    unknown = type(RIG)(RIG.format, RIG.cameras, None, RIG.frame)
    found = in_millimetres(unknown, "x", distance=("side0", "side2", 1234.5))
    assert np.linalg.norm(found.cameras[0].centre - found.cameras[2].centre) == pytest.approx(1234.5)
    for bad in (
        ("side0", "side0", 1.0),
        ("side0", "a", 1.0),
        ("side0", "side1", -1.0),
        ("side0", "side1", float("nan")),
    ):
        with pytest.raises(InputError, match="--distance: found"):
            in_millimetres(unknown, "x", distance=bad)
    with pytest.raises(InputError, match="expected one of them"):
        in_millimetres(unknown, "x", "m", ("side0", "side1", 1.0))
