"""Pages of one HTML file: style and scripts are inside, and nothing else may run or be fetched."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

SCRIPTS = ("viewer", "words", "scene", "timelines", "cameras", "pictures", "volume", "events", "controls", "main")
"""Files of the script, in the order in which they stand in the page: later ones use earlier ones."""


def round_values(values: NDArray[np.float64], digits: int = 5) -> Any:
    """Nested lists of numbers rounded to some significant digits; None for nan and infinity.

    Examples:
        >>> round_values(np.array([1.23456789, np.nan, 12345678.0]))
        [1.2346, None, 12346000.0]
    """
    values = np.asarray(values, dtype=np.float64)
    known = np.isfinite(values)
    size = np.where(known & (values != 0), np.abs(values), 1.0)
    scale = 10.0 ** (digits - 1 - np.floor(np.log10(size)))
    short = np.where(known, np.round(np.where(known, values, 0.0) * scale) / scale, np.nan)
    return _replace_nan(short.tolist())


def _replace_nan(values: Any) -> Any:
    if isinstance(values, list):
        return [_replace_nan(value) for value in values]
    return None if values != values else values


def to_json(content: Any) -> str:
    """Write JSON in one line, which may stand inside `<script>`, too."""
    text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def stream_event(kind: str, content: Any) -> bytes:
    """Write a server-sent event."""
    return f"event: {kind}\ndata: {to_json(content)}\n\n".encode()


@dataclass(frozen=True)
class Page:
    """A page and the policy that goes with it."""

    text: str
    policy: str  # Content-Security-Policy


def live_page(title: str, token: str) -> Page:
    """Make the page that watches; its commands have the token with them."""
    return _page(title, {"token": token}, "'self'")


def report_page(title: str, contents: dict[str, Any]) -> Page:
    """Make the same page of one moment, which opens without a server and commands nothing."""
    return _page(title, {"contents": contents}, "'none'")


def _page(title: str, data: dict[str, Any], connections: str) -> Page:
    script = "\n".join(read_asset(f"live_page/assets/{name}.js") for name in SCRIPTS)
    style = read_asset("live_page/assets/page.css")
    sources = {"img-src": "data: blob:", "connect-src": connections}
    return render_page("live_page/assets/page.html", style, [script], sources, title=title, data=Markup(to_json(data)))


def render_page(
    template: str, style: str, scripts: Sequence[str] = (), sources: Mapping[str, str] | None = None, **parts: Any
) -> Page:
    """Fill the template of a page that carries its style and scripts, and forbid it everything else.

    Args:
        template: a file below the package, which uses `policy`, `style` and `scripts`.
        style: the page's own style sheet, after the one that all pages share.
        scripts: what may run.
        sources: further directives of the Content-Security-Policy; a `style-src` replaces the digest of the style.
        **parts: what else the template uses.
    """
    style = read_asset("live_page/assets/base.css") + style
    directives = {
        "default-src": "'none'",
        "script-src": " ".join(_digest(script) for script in scripts) or "'none'",
        "style-src": _digest(style),
        "base-uri": "'none'",
        "form-action": "'none'",
    } | dict(sources or {})
    policy = "; ".join(f"{name} {allowed}" for name, allowed in directives.items())
    text = _template(template).render(
        policy=policy, style=Markup(style), scripts=[Markup(script) for script in scripts], **parts
    )
    return Page(text, f"{policy}; frame-ancestors 'none'")


def viewer_script() -> str:
    """The script that defines `Viewer`, a rig in 3D on a canvas; it reads the colours --page, --ink and --muted."""
    return read_asset("live_page/assets/viewer.js")


@cache
def read_asset(path: str) -> str:
    """Read a text file below the package."""
    return files("imgcal").joinpath(*path.split("/")).read_text(encoding="utf-8")


@cache
def _template(path: str) -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(read_asset(path))


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
