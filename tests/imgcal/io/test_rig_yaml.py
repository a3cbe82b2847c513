from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from imgcal.errors import InputError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import RigCovariance, load_rig_covariance, read_rig, save_cameras, save_rig
from imgcal.types import CameraRig, ConvexVolume, DriftRate, RigPrior


def make_rig(numbers: torch.Tensor, names: tuple[str, ...] = ("a", "b", "c")) -> CameraRig:
    """Make a rig of the given numbers: (C, 15) rotation, translation, f - 1000, principal point, distortion."""
    rotation, translation, focal, centre, distortion = numbers.split((3, 3, 2, 2, 5), dim=-1)
    return CameraRig(
        focal_length=1000 + focal,
        principal_point=centre,
        distortion=distortion,
        cam_from_rig=RigidTransform(rotation_from_vector(rotation), translation),
        image_size=torch.tensor([[2048, 1088]] * len(numbers)),
        camera_names=names,
        name="made",
        working_distance=850.5,
        prior=RigPrior(rotation=0.123),
        drift_rate=DriftRate(position=0.0),
    )


def covariance_of(cameras: int) -> RigCovariance:
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(15 * cameras, 15 * cameras, generator=generator, dtype=torch.float64)
    root[:6] = 0  # the reference camera's place is exact
    return RigCovariance.from_matrix(root @ root.mT / 100, cameras, "a")


@pytest.mark.parametrize(("name", "cameras"), [("O10", 10), ("O6", 6), ("U7", 7), ("T4", 4)])
def test_shipped_rigs_load_by_name(name: str, cameras: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    rig = read_rig(name)
    assert (rig.name, rig.num_cameras) == (name, cameras)
    (tmp_path / name).mkdir()  # a folder of that name, a capture perhaps, is in nobody's way
    assert read_rig(name).num_cameras == cameras


finite = st.floats(-1e3, 1e3, allow_nan=False)
small = st.floats(-0.5, 0.5, allow_nan=False)
camera_numbers = st.tuples(*[small] * 3, *[finite] * 3, *[st.floats(-900, 900)] * 2, *[finite] * 2, *[small] * 5)


@settings(max_examples=50, deadline=None)
@given(st.lists(camera_numbers, min_size=3, max_size=3))
def test_round_trip_is_exact(tmp_path_factory: pytest.TempPathFactory, numbers: list[tuple[float, ...]]) -> None:
    rig = make_rig(torch.tensor(numbers, dtype=torch.float64))
    path = tmp_path_factory.getbasetemp() / "round.yaml"
    # Near the smallest focal lengths half a unit of distortion is absurd.
    rig = replace(rig, distortion=rig.distortion * (rig.focal_length.amin() / 2000).clamp(max=1) ** 6)
    save_rig(rig, path)
    loaded = read_rig(path)
    for name in ("focal_length", "principal_point", "distortion", "image_size"):
        assert torch.equal(getattr(loaded, name), getattr(rig, name))
    assert torch.equal(loaded.cam_from_rig.translation, rig.cam_from_rig.translation)
    torch.testing.assert_close(loaded.cam_from_rig.rotation, rig.cam_from_rig.rotation, rtol=0, atol=4e-15)
    assert (loaded.camera_names, loaded.name, loaded.working_distance, loaded.prior, loaded.drift_rate) == (
        rig.camera_names, rig.name, rig.working_distance, rig.prior, rig.drift_rate,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["no", "1", "1e5", "a: b", "kamera ü", "#1", "null", "2024-01-01"])
def test_names_that_look_like_something_else_survive(name: str, tmp_path: Path) -> None:
    rig = make_rig(torch.zeros(1, 15, dtype=torch.float64), (name,))
    save_rig(rig, tmp_path / "r.yaml")
    assert read_rig(tmp_path / "r.yaml").camera_names == (name,)


@pytest.mark.parametrize(
    "volume",
    [ConvexVolume.box((-1, -2, 3), (1, 2, 4.5)), ConvexVolume(((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 7.25)))],
)
def test_a_volume_survives(volume: ConvexVolume, tmp_path: Path) -> None:
    save_rig(replace(make_rig(torch.zeros(3, 15, dtype=torch.float64)), volume=volume), tmp_path / "r.yaml")
    assert read_rig(tmp_path / "r.yaml").volume == volume
    assert ("low" in (tmp_path / "r.yaml").read_text()) == volume.is_box


def test_lens_models_round_trip(tmp_path: Path) -> None:
    models = ("equidistant", "brown_conrady", "rational")
    rig = make_rig(torch.zeros(3, 15, dtype=torch.float64))
    lenses = torch.zeros(3, 8, dtype=torch.float64)
    lenses[0, :4], lenses[1, :5], lenses[2] = 0.01, 0.02, torch.linspace(0.01, 0.08, 8)
    rig = replace(rig, distortion=lenses, lens_model=models)
    root = torch.randn(54, 54, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    root.view(3, 18, 54)[0, 14:] = root.view(3, 18, 54)[1, 15:] = 0
    path = tmp_path / "r.yaml"
    covariance = RigCovariance.from_matrix(root @ root.mT / 100, 3)
    save_rig(rig, path, covariance, full=True)
    back, known = read_rig(path), load_rig_covariance(path)
    assert back.lens_model == models and torch.equal(back.distortion, lenses)
    assert known is not None and known.matrix is not None and torch.equal(known.matrix, covariance.matrix)
    assert "distortion: [0.01, 0.01, 0.01, 0.01]" in path.read_text()
    one = rig.select([0])  # as wide as the rig that it is of; the file is not
    save_rig(one, path, RigCovariance.from_matrix(covariance.matrix[:18, :18], 1), full=True)
    narrow = read_rig(path)
    assert narrow.lens_model == "equidistant" and narrow.distortion.shape == (1, 5)
    points = torch.tensor([[50.0, -20.0, 900.0]], dtype=torch.float64)
    torch.testing.assert_close(narrow.project(points).uv, one.project(points).uv, rtol=0, atol=1e-9)


def test_covariance_round_trip(tmp_path: Path) -> None:
    rig, path = make_rig(torch.zeros(3, 15, dtype=torch.float64)), tmp_path / "r.yaml"
    covariance = covariance_of(3)
    save_rig(rig, path, covariance, full=True)
    loaded = load_rig_covariance(path)
    assert loaded is not None and loaded.matrix is not None and covariance.matrix is not None
    assert torch.equal(loaded.matrix, covariance.matrix)
    assert torch.equal(loaded.std, covariance.std)
    assert loaded.reference_camera == "a"
    save_rig(rig, path, covariance)
    loaded = load_rig_covariance(path)
    assert loaded is not None and loaded.matrix is None
    torch.testing.assert_close(loaded.std, covariance.std, rtol=1e-5, atol=0)
    assert read_rig(path).num_cameras == 3
    assert max(map(len, path.read_text().splitlines())) < 300


def test_deep_nesting_is_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "deep.yaml").write_text("[" * 5000)
    with pytest.raises(InputError, match=r"deep\.yaml: not valid YAML"):
        read_rig(tmp_path / "deep.yaml")


def test_unknown_name_offers_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"O11: no such file.*O10, O6, T4, U7.*nearest: O10"):
        read_rig("O11")
    with pytest.raises(InputError, match="found a folder"):
        read_rig(tmp_path)


def test_what_could_not_be_read_again_is_not_written(tmp_path: Path) -> None:
    rig, path = make_rig(torch.zeros(3, 15, dtype=torch.float64)), tmp_path / "r.yaml"
    broken = replace(rig, focal_length=rig.focal_length * float("nan"))
    with pytest.raises(InputError, match=r"not written: camera a: focal_length\[0\]: found nan"):
        save_rig(broken, path)
    with pytest.raises(InputError, match="expected one rig"):
        save_rig(rig.expand(2), path)
    assert not path.exists()


def test_cameras_without_places_are_no_rig_and_the_way_on_is_told(tmp_path: Path) -> None:
    save_cameras({"left": (1280, 1024), "right": (1280, 1024)}, 65.0, tmp_path / "cameras.yaml")
    with pytest.raises(InputError, match=r"found `format: 'imgcal-cameras/1'`.* given as --cameras instead of --rig"):
        read_rig(tmp_path / "cameras.yaml")
