"""`Format`: what each module of a format provides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig
from imgcal.formats.source import Source

Files = dict[str, bytes]
"""What a writer makes: names of files in a folder and what they hold; "" names the one file of a format without."""


@dataclass(frozen=True)
class Format:
    """A file format of another tool."""

    name: str  # as in `--from` and `--to`
    title: str  # as people call it
    recognizes: Callable[[Source], bool]
    read: Callable[[Source], ForeignRig]
    write: Callable[[ForeignRig], Files] | None = None  # in `unit`; None = read only
    holds: Holds = Holds()  # which lenses it can store
    accepts: Callable[[Source], bool] | None = None  # what to read if the user names the format; None = `recognizes`
    unit: str = "m"  # of what is written
    states_unit: bool = False  # the file, or the tool's custom, says what its unit is
    from_first: bool = False  # its rig frame is its first camera's
    cameras: tuple[int, int] = (1, 256)  # how many it can hold
    numbers_cameras: bool = False  # its files have no names of cameras, only their order
    stem: str = ""  # what its tool calls the file, without the suffix, where that is always the same
    # Cameras alone, also those that have no pose; None = those of `read`.
    read_lenses: Callable[[Source], list[ForeignCamera]] | None = None
