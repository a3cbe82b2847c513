"""The page's one HTML file: style and script are inside, and nothing else may run or be fetched."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

SCRIPTS = ("viewer", "words", "scene", "timelines", "cameras", "pictures", "volume", "events", "controls", "main")
"""Files of the script, in the order in which they stand in the page: later ones use earlier ones."""


def round_values(values: NDArray[np.float64], digits: int = 5) -> Any:
    """Nested lists of numbers of so many significant digits; None for nan and infinity.

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
    style, script = _style(), _script()
    policy = content_policy([script], f"'{_digest(style)}'", "data: blob:", connections)
    text = _asset("page.html")
    parts = {
        "POLICY": escape(policy), "TITLE": escape(title), "STYLE": style, "DATA": to_json(data), "SCRIPT": script
    }  # fmt: skip
    for name, part in parts.items():
        before, mark, after = text.partition(f"<!--{name}-->")
        assert mark, name
        text = before + part + after
    return Page(text, f"{policy}; frame-ancestors 'none'")


def content_policy(scripts: Sequence[str], styles: str, images: str, connections: str = "'none'") -> str:
    """Forbid a page everything but the scripts that it carries, and what is listed: a Content-Security-Policy."""
    digests = " ".join(f"'{_digest(script)}'" for script in scripts)
    return (
        f"default-src 'none'; script-src {digests}; style-src {styles}; img-src {images}; connect-src {connections}; "
        "base-uri 'none'; form-action 'none'"
    )


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


@cache
def _script() -> str:
    return "\n".join(_asset(f"{name}.js") for name in SCRIPTS)


def viewer_script() -> str:
    """The script that defines `Viewer`, a rig in 3D on a canvas; it reads the colours --page, --ink and --muted."""
    return _asset("viewer.js")


@cache
def _style() -> str:
    return _asset("page.css")


@cache
def _asset(name: str) -> str:
    return files("imgcal.live_page").joinpath("assets", name).read_text(encoding="utf-8")
