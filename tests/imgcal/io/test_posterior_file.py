"""The posterior file next to rig.yaml: exact, attached by read_rig, and one-line errors for damage."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import imgcal
from imgcal.io import read_posterior, read_rig, save_rig, write_posterior
from imgcal.types import RigPosterior


def posterior_for(rig: imgcal.CameraRig) -> RigPosterior:
    size = rig.num_cameras * rig.num_parameters
    factor = torch.eye(size, dtype=torch.float64) + torch.ones(size, size, dtype=torch.float64).tril() / 7
    points = torch.arange(24, dtype=torch.float64).view(8, 3)
    none = torch.zeros(8, dtype=torch.float64)
    unit = torch.full((rig.num_cameras, rig.num_parameters), 0.3, dtype=torch.float64)
    return RigPosterior(rig, points, none, 0.0, none[:0], factor, unit, 12, 1700000000.5)


def test_what_is_written_is_read_again_exactly(tmp_path: Path) -> None:
    rig = imgcal.load_rig("T4")
    posterior = posterior_for(rig)
    write_posterior(tmp_path / "p.safetensors", posterior)
    again = read_posterior(tmp_path / "p.safetensors", rig)
    for name in ("points", "tolerance", "object_offset", "factor", "unit"):
        assert torch.equal(getattr(again, name), getattr(posterior, name))
    assert (again.snapshots, again.time, again.scale_tolerance) == (12, 1700000000.5, 0.0)
    assert again.belongs_to(rig)


def test_load_rig_attaches_it_unless_the_file_is_gone_or_the_rig_was_edited(tmp_path: Path) -> None:
    rig, path = imgcal.load_rig("T4"), tmp_path / "rig.yaml"
    save_rig(rig, path, posterior=posterior_for(rig))
    found = read_rig(path)
    assert found.posterior is not None
    assert found.posterior().belongs_to(found)
    path.write_text(path.read_text().replace(str(float(rig.focal_length[0, 0])), "1500.0", 1))
    edited = read_rig(path)
    assert edited.posterior is not None
    assert not edited.posterior().belongs_to(edited)
    (tmp_path / "rig.posterior.safetensors").unlink()
    assert read_rig(path).posterior is None


def test_damage_is_one_line_that_names_the_file(tmp_path: Path) -> None:
    rig, path = imgcal.load_rig("T4"), tmp_path / "p.safetensors"
    write_posterior(path, posterior_for(rig))
    with pytest.raises(imgcal.InputError, match=r"p\.safetensors: found arrays .* expected \(2, 15\)"):
        read_posterior(path, rig.select([0, 1]))
    broken = posterior_for(rig)
    write_posterior(path, replace(broken, factor=-broken.factor))
    with pytest.raises(imgcal.InputError, match="positive-definite"):
        read_posterior(path, rig)
    content = bytearray(path.read_bytes())
    content[-9] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(imgcal.InputError, match="damaged"):
        read_posterior(path, rig)
