from dataclasses import replace
from pathlib import Path

import pytest
import torch

from imgcal.errors import InputError
from imgcal.formats import FORMATS, OURS, convert_rig, find_format, from_camera_rig, select_cameras
from imgcal.geometry import lens_label
from imgcal.io import RigCovariance, load_rig_covariance, read_rig
from imgcal.types import RigPosterior
from tests.imgcal.formats.rigs import brown, rig_of

WRITTEN = [OURS, *(one.name for one in FORMATS if one.write is not None)]


@pytest.mark.parametrize("to", WRITTEN)
def test_every_format_is_read_back(to: str) -> None:
    count = 3 if to == OURS else min(3, find_format(to).cameras[1])
    rig = rig_of(*[brown(-0.1, 0.02, 0.001, -0.002), brown(0.05), brown()][:count])
    made = convert_rig(rig, to, "x")
    assert made.round_trip < 1e-8
    assert made.between_models < 1e-8
    assert made.points == count * 147


def test_uncertainty_goes_along_where_there_is_a_place() -> None:
    rig = replace(
        rig_of(brown(-0.1), brown()), covariance=RigCovariance(torch.full((2, 15), 0.25, dtype=torch.float64))
    )
    assert "std:" in convert_rig(rig, OURS, "x").files[""].decode()
    assert any("standard deviations are left out" in note for note in convert_rig(rig, "kalibr", "x").notes)


def test_a_posterior_that_is_left_out_is_noted() -> None:
    def posterior() -> RigPosterior:
        raise AssertionError("nobody needs it")

    rig = read_rig("T4").select([0, 1])
    for known in (rig, replace(rig, posterior=posterior)):
        notes = convert_rig(from_camera_rig(known), "kalibr", "x").notes
        assert any("the posterior of the calibration is left out" in note for note in notes) == (known is not rig)


def test_a_rig_of_ours_keeps_its_lens_models_and_its_covariance(tmp_path: Path) -> None:
    rig = read_rig("T4").select([0, 1])
    distortion = torch.nn.functional.pad(rig.distortion, (0, 3))  # k4 to k6 are zero
    rig = replace(rig, distortion=distortion, lens_model=lens_label(["rational", "brown_conrady"]))
    width = rig.num_parameters
    draws = torch.randn(2 * width, 2 * width, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    draws[2 * width - 3 :] = 0  # k4 to k6 of the second camera
    covariance = RigCovariance.from_matrix(1e-6 * draws @ draws.T, 2)
    made = convert_rig(from_camera_rig(rig, covariance), OURS, "x")
    (tmp_path / "rig.yaml").write_bytes(made.files[""])
    kept = load_rig_covariance(tmp_path / "rig.yaml")
    assert read_rig(tmp_path / "rig.yaml").lens_models == rig.lens_models
    assert kept is not None and kept.matrix is not None and covariance.matrix is not None
    assert torch.equal(kept.matrix, covariance.matrix)
    assert made.notes == ()


def test_a_unit_that_the_format_states_is_not_another() -> None:
    rig = rig_of(brown(), brown())
    assert convert_rig(rig, "anipose", "x", unit="inch").round_trip < 1e-8
    with pytest.raises(InputError, match="Kalibr camchain is always in m"):
        convert_rig(rig, "kalibr", "x", unit="mm")


def test_what_cannot_be_written() -> None:
    rig = rig_of(brown(), brown(), brown())
    with pytest.raises(
        InputError, match=r"Vicon .* can only be read, or written back .*--into.*, expected one of imgcal"
    ):
        convert_rig(rig, "vicon", "x")
    with pytest.raises(InputError, match="holds 1 to 2 cameras, found 3: choose with --cameras"):
        convert_rig(rig, "ros", "x")


@pytest.mark.parametrize(("to", "names"), [("kalibr", ("cam1", "cam0")), ("opencv-stereo", ("2", "1"))])
def test_a_format_that_numbers_cameras_keeps_their_order(to: str, names: tuple[str, str]) -> None:
    rig = rig_of(brown(-0.1), brown(0.05), names=names)
    made = convert_rig(rig, to, "x")
    assert made.round_trip < 1e-8
    assert f"the cameras have other names in the files, in this order: {names[1]}, {names[0]}" in made.notes
    ordered = convert_rig(select_cameras(rig, names[::-1]), to, "x")
    assert not any("other names" in note for note in ordered.notes)


def test_cameras_are_chosen_by_name() -> None:
    rig = rig_of(brown(), brown(), brown())
    assert select_cameras(rig, ("side2", "side0")).names == ["side2", "side0"]
    for bad in (("side7",), ("side0", "side0")):
        with pytest.raises(InputError, match="--cameras: found"):
            select_cameras(rig, bad)


def test_uncertainty_of_the_cameras_that_are_kept() -> None:
    spread = torch.arange(1.0, 46.0, dtype=torch.float64).reshape(3, 15)
    rig = replace(
        rig_of(brown(), brown(), brown()),
        covariance=RigCovariance(spread, torch.diag(spread.flatten().square()), "side1"),
    )
    kept = select_cameras(rig, ("side2", "side1")).covariance
    assert kept is not None
    assert torch.allclose(kept.std, spread[[2, 1]])
    assert kept.matrix is not None
    assert torch.allclose(kept.matrix, torch.diag(spread[[2, 1]].flatten().square()))
    assert "std:" in convert_rig(select_cameras(rig, ("side2", "side1")), OURS, "x").files[""].decode()
    without = select_cameras(rig, ("side2", "side0"))
    assert without.covariance is None
    assert any("relative to camera side1" in note for note in without.notes)
