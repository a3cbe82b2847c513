from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from imgcal.cli.main import main
from imgcal.io import load_object, read_rig, save_object, save_rig


@dataclass(frozen=True)
class Workplace:
    """A small rig, an object and a simulated capture, on disk."""

    folder: Path
    rig: Path
    object: Path
    capture: Path


@pytest.fixture(scope="session")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Workplace:
    folder = tmp_path_factory.mktemp("workplace")
    rig, obj, capture = folder / "factory.yaml", folder / "object.csv", folder / "capture"
    save_rig(read_rig("T4").resized(torch.tensor([512, 272])), rig)
    save_object(load_object("asymmetric8"), obj)
    arguments = ["simulate", "--rig", str(rig), "--object", str(obj), "--out", str(capture)]
    assert main([*arguments, "--snapshots", "3", "--seed", "5", "--kappa", "0.01", "--no-clutter"]) == 0
    return Workplace(folder, rig, obj, capture)
