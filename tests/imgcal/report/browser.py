"""Content of a report in a real browser window of a given width."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

TURN = """
  const view = window, page = document;
  const painted = () => new Promise((done) => requestAnimationFrame(done));
  const turn = async () => { await painted(); await painted(); await painted(); };
  await turn();
"""
"""A size is seen when one frame is laid out, asks for a drawing in the next, and that is there at the third."""


def measured(browser: BrowserContext, page: Path, width: int, script: str, *, height: int = 900) -> dict[str, Any]:
    """Open a page in a window of `width` x `height` pixels and return what a script finds.

    The script is the body of an async function, in which `page` is the document, `view` its window, and
    `await turn()` waits until the page has been drawn again. What the page complains of is under "complaints".
    """
    tab, complaints = browser.new_page(), []
    tab.on("console", lambda message: complaints.append(message.text))
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    try:
        tab.set_viewport_size({"width": width, "height": height})
        tab.goto(page.as_uri())
        found: dict[str, Any] = tab.evaluate(f"async () => {{ {TURN} {script} }}")
    finally:
        tab.close()
    return found | {"complaints": complaints}
