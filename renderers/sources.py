"""Digest of a module: its source, and the modules of its package that it imports."""

from __future__ import annotations

import hashlib
import re
import sys
from functools import cache
from pathlib import Path

PACKAGES = ("imgcal", "renderers")


def source_digest(module: str) -> str:
    """Digest the sources of an imported module and of those it imports from its own package and from ours.

    Imports inside functions do not count. A module without a file counts as empty.
    """
    packages = {*PACKAGES, module.partition(".")[0]}
    found, waiting = {module}, [module]
    while waiting:
        new = {name for name in _imported_modules(waiting.pop()) if name.partition(".")[0] in packages} - found
        found |= new
        waiting += new
    return hashlib.sha256("".join(map(_digest, sorted(found))).encode()).hexdigest()


@cache
def _source(module: str) -> bytes:
    try:
        return Path(sys.modules[module].__file__ or "").read_bytes()
    except (KeyError, AttributeError, OSError):
        return b""


@cache
def _digest(module: str) -> str:
    return hashlib.sha256(module.encode() + _source(module)).hexdigest()


@cache
def _imported_modules(module: str) -> frozenset[str]:
    """Modules named in its import statements; for a name that a package re-exports, the module that defines it."""
    source = _source(module).decode()
    found = set(re.findall(r"^import ([\w.]+)", source, re.MULTILINE))
    for origin, names in re.findall(r"^from ([\w.]+) import (\([^)]*\)|.*)", source, re.MULTILINE):
        lender = sys.modules.get(origin)
        if not hasattr(lender, "__path__"):
            found.add(origin)
            continue
        for name in re.findall(r"\w+", names):
            own = f"{origin}.{name}"
            found.add(own if own in sys.modules else getattr(getattr(lender, name, None), "__module__", origin))
    return frozenset(found)
