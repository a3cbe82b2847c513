"""A real browser that opens a report in a window of some width and says what it sees; Debian's package `chromium`."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def measured(page: Path, width: int, script: str, *, height: int = 900) -> dict[str, Any]:
    """Open a page in a frame of `width` pixels and return what a script finds.

    The script is the body of an async function, in which `page` is the document and `view` its window. What the page
    itself complains of is under "complaints".
    """
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        pytest.skip("needs a browser: apt-get install --no-install-recommends chromium")
    holder = page.with_name(f"{page.stem}-{width}.html")
    holder.write_text(
        f"""<body style="margin:0"><iframe src="{page.as_uri()}" style="border:0;width:{width}px;height:{height}px">
</iframe><pre></pre><script>
onload = async () => {{
  const view = document.querySelector("iframe").contentWindow, page = view.document;
  const pause = () => new Promise((resolve) => setTimeout(resolve, 150));
  await pause();
  let found;
  try {{ found = await (async () => {{ {script} }})(); }} catch (error) {{ found = {{error: String(error)}}; }}
  document.querySelector("iframe").remove();
  document.querySelector("pre").textContent = JSON.stringify(found);
}};
</script>"""
    )
    options = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-web-security",
        "--allow-file-access-from-files",
    ]
    options += [f"--user-data-dir={page.parent / 'browser'}", "--enable-logging=stderr", "--virtual-time-budget=8000"]
    done = subprocess.run(
        [browser, *options, f"--window-size={max(width, 500)},{height}", "--dump-dom", holder.as_uri()],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    written = re.search(r"<pre>(.*?)</pre>", done.stdout, re.DOTALL)
    assert written and written[1], done.stderr[-2000:]
    found: dict[str, Any] = json.loads(html.unescape(written[1]))
    assert "error" not in found, found["error"]
    found["complaints"] = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return found
