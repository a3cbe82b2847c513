import re
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from imgcal.errors import InputError, RefusedError
from imgcal.formats import ForeignRig, Lens, fit_to_target, from_camera_rig, known_points, to_camera_rig, write_into
from imgcal.formats.conversion import NATIVE
from tests.imgcal.formats import originals
from tests.imgcal.formats.rigs import apart, brown, fisheye, read_in_mm, rig_of

NOW = datetime(2026, 11, 24, 3, 30, 5)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
RIG = rig_of(
    brown(-0.05, 0.02, 1e-4, -2e-4, 0.003), brown(-0.06, 0.03, 2e-4, 1e-4, 0.002), 
    brown(-0.055, 0.025, 1e-5, 1e-5, 1e-3),
    names=("a1", "b2", "c3"),
)  # fmt: skip
WRITERS: dict[str, Callable[[ForeignRig], bytes]] = {
    "vicon": originals.vicon, "motive": originals.motive, "qualisys": originals.qualisys,
}  # fmt: skip


@pytest.fixture(params=WRITERS)
def original(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / f"{request.param}.xml"
    path.write_bytes(WRITERS[request.param](RIG))
    return path


def ours(path: Path) -> ForeignRig:
    """What a user has after reading the file: a rig of our own."""
    held = fit_to_target(read_in_mm(path), NATIVE, "ours")
    return from_camera_rig(to_camera_rig(held.rig, "x"))


def text_of(content: bytes) -> str:
    return content.decode("utf-16" if content[:2] == b"\xff\xfe" else "utf-8")


def test_only_numbers_of_cameras_that_moved_are_replaced(original: Path, tmp_path: Path) -> None:
    rig = originals.drifted(ours(original), names=("a1", "c3"))
    made = write_into(rig, [original], NOW)
    assert (made.changed, made.kept) == (("a1", "c3"), ("b2",))
    before, after = text_of(original.read_bytes()), text_of(made.files[original.name])
    assert NUMBER.sub("#", before) == NUMBER.sub("#", after)
    kept = re.compile(r"(?is)<camera [^>]*(?:Serial|DEVICEID)=.b2.*?</camera>")
    assert kept.search(before)[0] == kept.search(after)[0]
    assert made.files[original.name][:2] == original.read_bytes()[:2]
    changed = {one[0] for one, other in zip(values_of(before), values_of(after), strict=True) if one != other}
    assert not {"WORLD_ERROR", "avg-residual", "Exposure", "DATA", "FRAME", "ImagerPixelWidth", "right"} & changed
    (tmp_path / "new.xml").write_bytes(made.files[original.name])
    loss = made.loss.worst if made.loss is not None else 0.0
    assert loss < 0.05
    assert made.reread < 1e-3
    assert apart(rig, read_in_mm(tmp_path / "new.xml")) <= loss + made.reread


def values_of(text: str) -> list[tuple[str, str]]:
    return re.findall(r"([\w-]+)\s*=\s*[\"']([^\"']*)", text)


def project_vicon(camera: ElementTree.Element, points: np.ndarray) -> np.ndarray:
    """The ideal pixels of points, as the file says them."""
    frame = next(camera.iter("KeyFrame"))
    x, y, z, w = map(float, frame.attrib["ORIENTATION"].split())
    v = points - np.array(list(map(float, frame.attrib["POSITION"].split())))
    q = np.array([x, y, z])
    v = v + 2 * np.cross(q, np.cross(q, v) + w * v)
    centre = np.array(list(map(float, frame.attrib["PRINCIPAL_POINT"].split())))
    f = float(frame.attrib["FOCAL_LENGTH"])
    return v[:, :2] / v[:, 2:] * [f, f / float(camera.attrib["PIXEL_ASPECT_RATIO"])] + centre


def undistort_vicon(camera: ElementTree.Element, uv: np.ndarray) -> np.ndarray:
    cx, cy, *ks = map(float, next(camera.iter("KeyFrame")).attrib["VICON_RADIAL2"].split()[1:])
    d = uv - [cx, cy]
    square = d[:, :1] ** 2 + (d[:, 1:] * float(camera.attrib["PIXEL_ASPECT_RATIO"])) ** 2
    return uv + d * sum(k * square ** (n + 1) for n, k in enumerate(ks))


def project_motive(camera: ElementTree.Element, points: np.ndarray) -> np.ndarray:
    pose, lens = camera.find("Extrinsic").attrib, camera.find("IntrinsicStandardCameraModel").attrib
    axes = np.array([float(pose[f"OrientMatrix{n}"]) for n in range(9)]).reshape(3, 3)
    v = (points - [1000 * float(pose[axis]) for axis in "XYZ"]) @ axes * [1, -1, -1]
    uv = bent(v, *(float(lens[key]) for key in ("k1", "k2", "TangentialX", "TangentialY", "k3")))
    focal = [float(lens[f"{side}FocalLength"]) for side in ("Horizontal", "Vertical")]
    return uv * focal + [float(lens["LensCenterX"]), float(lens["LensCenterY"])]


def project_qualisys(camera: ElementTree.Element, points: np.ndarray) -> np.ndarray:
    pose, lens = camera.find("transform").attrib, camera.find("intrinsic").attrib
    axes = np.array([float(pose[f"r{r}{c}"]) for r in (1, 2, 3) for c in (1, 2, 3)]).reshape(3, 3)
    v = (points - [float(pose[axis]) for axis in "xyz"]) @ axes.T * [1, -1, -1]
    ks = [float(lens[key]) for key in ("radialDistortion1", "radialDistortion2", "tangentalDistortion1",
                                       "tangentalDistortion2", "radialDistortion3")]  # fmt: skip
    return (
        bent(v, *ks) * [float(lens["focalLengthU"]), float(lens["focalLengthV"])]
        + [float(lens["centerPointU"]), float(lens["centerPointV"])]
    ) / 64


def bent(v: np.ndarray, k1: float, k2: float, p1: float, p2: float, k3: float) -> np.ndarray:
    x, y = (v[:, :2] / v[:, 2:]).T
    s = x * x + y * y
    radial = 1 + k1 * s + k2 * s**2 + k3 * s**3
    return np.stack(
        (x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y), -1
    )


def test_independent_readers_see_the_rig(original: Path, tmp_path: Path) -> None:
    rig = originals.drifted(ours(original))
    made = write_into(rig, [original], NOW)
    loss = made.loss.worst if made.loss is not None else 0.0
    root = ElementTree.fromstring(made.files[original.name])
    elements = [*root.iter("Camera"), *root.iter("camera")]
    for element, camera, points in zip(elements, rig.cameras, known_points(rig), strict=True):
        uv = camera.project(points)
        if original.stem == "vicon":
            away = undistort_vicon(element, uv) - project_vicon(element, points)
        else:
            project = project_motive if original.stem == "motive" else project_qualisys
            away = project(element, points) - uv
        assert np.abs(away).max() <= 1.2 * loss + made.reread + 1e-9


def test_what_did_not_change_stays_to_the_last_byte(original: Path) -> None:
    made = write_into(ours(original), [original], NOW)
    if original.stem != "vicon":  # whose lens is fitted, and fitted back
        assert made.files[original.name] == original.read_bytes()
        assert made.changed == ()


def test_times_of_calibration(tmp_path: Path) -> None:
    for name, said in (
        ("motive", "Date set to 2026-11-24 03:30:05"),
        ("qualisys", "created set to 2026-11-24 03:30:05"),
    ):
        path = tmp_path / f"{name}.xml"
        path.write_bytes(WRITERS[name](RIG))
        made = write_into(originals.drifted(ours(path)), [path], NOW)
        assert any(said in note for note in made.notes)
        text = text_of(made.files[path.name])
        if name == "motive":
            assert '<Date Day="24" Hour="3" Minute="30" Month="11" Second="5" Year="2026"/>' in text
        else:
            assert 'created="2026-11-24 03:30:05"' in text


def test_cameras_that_are_missing(original: Path) -> None:
    rig = originals.drifted(ours(original))
    some = replace(rig, cameras=rig.cameras[:2], own=None)
    assert write_into(some, [original], NOW).kept == ("c3",)
    other = replace(rig, cameras=(*rig.cameras[:2], replace(rig.cameras[2], name="zz")), own=None)
    with pytest.raises(InputError, match="found cameras a1, b2, c3, expected also camera zz"):
        write_into(other, [original], NOW)


def test_a_lens_that_the_file_cannot_say_is_refused(original: Path) -> None:
    rig = ours(original)
    wide = replace(
        rig, cameras=(*rig.cameras[:2], replace(rig.cameras[2], lens=fisheye(0.2, 0.3, -0.2, 0.1))), own=None
    )
    with pytest.raises(RefusedError, match=r"camera c3: .* cannot express its lens .*more than the limit of 0.05 px"):
        write_into(wide, [original], NOW)
    near = replace(rig.cameras[2], lens=Lens((1010.0, 1010.0), (640.0, 480.0), (-0.05, 0.01, 1e-5, 0, 0, 1e-3)))
    made = write_into(replace(rig, cameras=(*rig.cameras[:2], near), own=None), [original], NOW, limit=1.0)
    assert made.loss is not None and 0 < made.loss.worst < 1.0


def test_another_frame_is_refused_where_a_camera_would_stay_behind(original: Path) -> None:
    rig = ours(original).in_camera_frame()
    made = write_into(rig, [original], NOW)
    assert any("the frame of the rig is not that of the file" in note for note in made.notes)
    with pytest.raises(InputError, match=r"another frame than the file .*camera c3, which the rig does not have"):
        write_into(replace(rig, cameras=rig.cameras[:2], own=None), [original], NOW)


def damaged(content: bytes, kind: int, generator: np.random.Generator) -> bytes:
    """A content that is cut off, of which a bit is flipped, or that lacks a line."""
    place = int(generator.integers(len(content)))
    if kind == 0:
        return content[:place]
    if kind == 1:
        return content[:place] + bytes([content[place] ^ 1 << int(generator.integers(8))]) + content[place + 1 :]
    end = b"\n\0" if content[:2] == b"\xff\xfe" else b"\n"
    lines = content.split(end)
    del lines[int(generator.integers(len(lines)))]
    return end.join(lines)


def test_damaged_originals(original: Path, tmp_path: Path) -> None:
    """One line of error, or a correct result."""
    rig = originals.drifted(ours(original))
    content = original.read_bytes()
    generator = np.random.default_rng(3)
    outcomes = {"refused": 0, "written": 0}
    for number in range(15):
        original.write_bytes(damaged(content, number % 3, generator))
        try:
            result = write_into(rig, [original], NOW)
        except (InputError, RefusedError) as error:
            assert "\n" not in str(error)
            outcomes["refused"] += 1
            continue
        (tmp_path / "new.xml").write_bytes(result.files[original.name])
        loss = result.loss.worst if result.loss is not None else 0.0
        assert apart(rig, read_in_mm(tmp_path / "new.xml")) <= 1.2 * loss + result.reread + 1e-9
        outcomes["written"] += 1
    assert min(outcomes.values()) > 0
