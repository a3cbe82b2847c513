"""The page's one HTML file: style and script are inside, and nothing else may run or be fetched."""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from typing import Any

from imgcal.live_page.text import to_json

SCRIPTS = ("words", "scene", "timelines", "cameras", "pictures", "volume", "events", "controls", "main")
"""Files of the script, in the order in which they stand in the page: later ones use earlier ones."""


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
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; img-src data: blob:; "
        f"connect-src {connections}; base-uri 'none'; form-action 'none'"
    )
    text = _asset("page.html")
    parts = {
        "POLICY": escape(policy), "TITLE": escape(title), "STYLE": style, "DATA": to_json(data), "SCRIPT": script
    }  # fmt: skip
    for name, part in parts.items():
        before, mark, after = text.partition(f"<!--{name}-->")
        assert mark, name
        text = before + part + after
    return Page(text, f"{policy}; frame-ancestors 'none'")


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


@cache
def _script() -> str:
    return '"use strict";\n' + "\n".join(_asset(f"{name}.js") for name in SCRIPTS)


@cache
def _style() -> str:
    return _asset("page.css")


@cache
def _asset(name: str) -> str:
    return files("imgcal.live_page").joinpath("assets", name).read_text(encoding="utf-8")
