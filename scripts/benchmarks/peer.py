"""Other tools, which may be absent: ``pip install -e '.[peers]'`` installs those on PyPI."""

from __future__ import annotations

import subprocess
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from types import ModuleType

DEBIAN_PYTHON = "/usr/bin/python3"


def peer(module: str) -> ModuleType | None:
    """Import a peer; None if it is not installed."""
    try:
        return import_module(module)
    except ModuleNotFoundError:
        return None


def versions(*distributions: str) -> dict[str, str]:
    """Versions of installed distributions, "absent" for the others."""
    found = {}
    for name in distributions:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found


@cache
def debian_mrcal() -> str | None:
    """Version of mrcal, which Debian ships for its own Python (packages mrcal, python3-mrcal); None if absent."""
    command = ["dpkg-query", "--show", "--showformat=${Version}", "python3-mrcal"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip() or None
