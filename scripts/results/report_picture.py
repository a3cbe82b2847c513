"""Take the picture of the report: the sample capture, calibrated as in the README.

Run as `python -m scripts.results.report_picture`; takes a minute and needs Debian's Chromium.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from imgcal.cli.main import main as imgcal
from imgcal.errors import InputError
from scripts.output import ROOT, command, save_picture

SAMPLE = "sample:O10"
ARGUMENTS = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run")


@dataclass(frozen=True)
class Options:
    """Take the picture of the report."""

    out: Path = ROOT / "docs" / "report.png"  #: image file to write
    width: int = 1320  #: pixels
    height: int = 1230  #: pixels


def main() -> None:
    """Calibrate the sample and take the picture."""
    options = tyro.cli(Options, description=__doc__)
    chromium = shutil.which("chromium")
    if chromium is None:
        raise InputError("chromium: not found, expected Debian's package chromium")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if imgcal(["calibrate", SAMPLE, "--rig", SAMPLE, "--object", SAMPLE, "--out", str(folder / "out")]):
            raise InputError(f"{SAMPLE}: not calibrated")
        picture, page = folder / "report.png", folder / "out" / "report.html"
        where = (f"--user-data-dir={folder / 'profile'}", f"--screenshot={picture}", page.as_uri())
        size = f"--window-size={options.width},{options.height}"
        subprocess.run([chromium, *ARGUMENTS, size, *where], check=True, capture_output=True, timeout=120)
        save_picture(picture.read_bytes(), options.out)


if __name__ == "__main__":
    command(main)
