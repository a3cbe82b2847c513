"""Take the picture of the live page: the demonstration with ten cameras, after cam07 was bumped and relearned.

Run as `python -m scripts.results.live_picture`; takes a minute and needs Debian's Chromium.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

import imgcal
from imgcal.errors import InputError
from imgcal.live_page import Address, Demonstration
from scripts.output import ROOT, command, save_picture

ARGUMENTS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Take the picture of the live page."""

    out: Path = ROOT / "docs" / "live.png"  #: image file to write
    before: float = 30.0  #: s before the bump
    after: float = 30.0  #: s after it
    rate: float = 15.0  #: snapshots a second
    width: int = 1400  #: pixels
    height: int = 1180  #: pixels
    scheme: Literal["light", "dark"] = "light"  #: colours of the page


def main() -> None:
    """Run the demonstration, bump a camera and take the picture."""
    options = tyro.cli(Options, description=__doc__)
    chromium = shutil.which("chromium")
    if chromium is None:
        raise InputError("chromium: not found, expected Debian's package chromium")
    from playwright.sync_api import sync_playwright

    rig, obj, ended = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8"), threading.Event()
    with Demonstration(rig, obj, Address(port=0)) as shown:
        running = threading.Thread(target=shown.run, args=(options.rate, ended))
        running.start()
        try:
            with sync_playwright() as playwright, tempfile.TemporaryDirectory() as profile:
                context = playwright.chromium.launch_persistent_context(
                    profile, executable_path=chromium, args=ARGUMENTS, color_scheme=options.scheme,
                    viewport={"width": options.width, "height": options.height},
                )  # fmt: skip
                page = context.new_page()
                page.goto(shown.page.url)
                learnt = "() => document.getElementById('detail').textContent"
                page.wait_for_function(learnt, timeout=300_000)  # the first run on a machine compiles code
                time.sleep(options.before)
                page.click("[data-action=bump]")
                time.sleep(options.after)
                picture = page.screenshot()
                print(page.inner_text("#sentence"))
                print(page.inner_text("#events"))
                context.close()
        finally:
            ended.set()
            running.join()
    save_picture(picture, options.out)


if __name__ == "__main__":
    command(main)
