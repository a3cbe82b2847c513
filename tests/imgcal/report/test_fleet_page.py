import datetime
from pathlib import Path

import numpy as np
import torch

from imgcal.fleet import Dataset, DriftInformation, Item, KindOfRig, learn_prior
from imgcal.fleet.job import failed_row
from imgcal.report import Taught, write_fleet_report
from imgcal.types import RigPrior


def results(folder: Path) -> Dataset:
    dataset = Dataset(folder)
    with dataset.open_writer() as writer:
        for number, status in enumerate(["ok", "ok", "refused"]):
            day = datetime.datetime(2026, 1, 1 + number, tzinfo=datetime.UTC).timestamp()
            row = failed_row(Item(number, "c", "T4", "cube8", f"<b>{number}", day), status, "identity: & unclear")
            writer.add([row | {"rms_px": 0.1 * number if status == "ok" else None}])
    return dataset


def kind(bump: float) -> KindOfRig:
    """Devices whose every value is measured well."""
    generator = torch.Generator().manual_seed(0)
    std = torch.tensor([0.003] * 3 + [1.5] * 3 + [0.004] * 2 + [3.0] * 2 + [0.01] * 5, dtype=torch.float64)
    offset = torch.randn(40, 15, generator=generator, dtype=torch.float64) * std
    offset[7, 0] += bump
    information = torch.diag((10 / std).square()).expand(40, 15, 15)
    score = (information @ offset[..., None])[..., 0]
    names = tuple(f"<device {number}>" for number in range(40))
    return KindOfRig(
        ("cam",), ("brown_conrady",), names, DriftInformation(("cam",), information, score), {"t": np.arange(40.0)}, {}
    )


def test_the_page_says_what_was_learnt_and_escapes_names(tmp_path: Path) -> None:
    dataset, bumped = results(tmp_path), kind(0.1)
    taught = [Taught(bumped, learn_prior(bumped.drift)), Taught(kind(0.0), None, "fleet: found 3 devices")]
    write_fleet_report(dataset, taught, RigPrior(), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "2 of 3 captures recalibrated, of 80 devices; 1 camera is farther off" in page
    assert "&lt;device 7&gt;" in page and "<device" not in page
    assert "identity" in page and "fleet: found 3 devices" in page
    assert page.count("<svg") >= 8 and "http" not in page.replace("http-equiv", "")


def test_the_same_results_give_the_same_page(tmp_path: Path) -> None:
    dataset = results(tmp_path)
    for name in ("one.html", "two.html"):
        write_fleet_report(dataset, [], RigPrior(), tmp_path / name)
    assert (tmp_path / "one.html").read_bytes() == (tmp_path / "two.html").read_bytes()
