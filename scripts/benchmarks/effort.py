"""How much a benchmark measures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Effort:
    """A full run, or a smoke run that checks within seconds that everything works."""

    smoke: bool = False

    def pick(self, full: T, smoke: T) -> T:
        """Choose by effort: ``effort.pick(500, 3)`` snapshots."""
        return smoke if self.smoke else full
