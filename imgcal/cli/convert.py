"""`imgcal convert`: the calibration of another tool to ours, ours to another tool's, or one tool's to another's."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from imgcal.errors import InputError
from imgcal.formats import (
    FORMATS,
    LIMIT,
    OURS,
    ForeignRig,
    Written,
    converted,
    format_named,
    from_camera_rig,
    in_millimetres,
    is_foreign,
    read_foreign_rig,
    selected,
    with_image_sizes,
)
from imgcal.io import load_rig, load_rig_covariance, publishing, write_bytes
from imgcal.messages import listed, shortened


@dataclass(frozen=True)
class Convert:
    """Convert the calibration of a rig: another tool's to ours, ours to another tool's, or one tool's to another's.

    What SOURCE is, its content says. What is written is read back and compared on known points in every camera; nothing
    is guessed, and what had to be assumed is printed. docs/formats.md has the formats.
    Example: imgcal convert camchain.yaml --out rig.yaml
    """

    source: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """a file, a folder, or the files that are one calibration together; a rig file of ours, or a shipped rig"""
    out: Path
    """file to write; a folder where the format has several files"""
    source_format: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """format of SOURCE by name, where its content is not to decide"""
    to: str | None = None
    """format to write by name (default: imgcal, where --out ends in .yaml)"""
    unit: str | None = None
    """unit of SOURCE, where its format does not say: mm, cm, m, inch, or the length of one unit, such as 417.2mm"""
    distance: tuple[str, str, float] | None = None
    """two cameras, and how many mm they are apart, where the unit is not known"""
    image_size: tuple[str, ...] = ()
    """WIDTHxHEIGHT of all cameras, or NAME=WIDTHxHEIGHT of one, where SOURCE does not say"""
    cameras: tuple[str, ...] = ()
    """names of the cameras to keep, in the order to write them (default: all)"""
    out_unit: str | None = None
    """unit to write, where the format leaves that to its user"""
    fit_limit: float = LIMIT
    """px that a lens may be off, anywhere in its image, where another model takes its place by a fit"""

    def run(self) -> None:
        """Read, convert, verify, write."""
        to = self._target()
        rig, title = self._read()
        print(f"{title}: {len(rig.cameras)} camera{'s' if len(rig.cameras) > 1 else ''}; frame: {rig.frame}")
        for note in rig.notes:
            print(f"note: {note}")
        made = converted(rig, to, self.out.stem, self.fit_limit, self.out_unit)
        for note in made.notes:
            print(f"note: {note}")
        self._write(made)
        models = f"{made.between_models:.2g} px" if made.between_models > 1e-6 else "the same"
        print(
            f"verified on {made.points} known points: read back worst {made.round_trip:.1e} px, lens models {models}\n"
            f"{to}: {listed(map(str, self._written(made)))}"
        )

    def _target(self) -> str:
        to = self.to if self.to is not None else OURS if self.out.suffix in (".yaml", ".yml") else None
        if to is None:
            able = ", ".join(one.name for one in FORMATS if one.write is not None)
            raise InputError(f"--to: not given, and {self.out.name} does not say it; expected one of imgcal, {able}")
        if to != OURS:
            format_named(to)
        if not 0 < self.fit_limit < float("inf"):
            raise InputError(f"--fit-limit: found {self.fit_limit}, expected pixels > 0")
        return to

    def _read(self) -> tuple[ForeignRig, str]:
        """The rig in millimetres with its image sizes, and what it is called."""
        where = ", ".join(map(str, self.source))
        sizes = dict(map(_size, self.image_size))
        first = self.source[0] if self.source else Path()
        ours = (
            len(self.source) == 1 and self.source_format in (None, OURS) and not (first.exists() and is_foreign(first))
        )
        if ours:
            if self.unit is not None or self.distance is not None:
                raise InputError(f"{where}: a rig file of our own is in mm, expected neither --unit nor --distance")
            rig = from_camera_rig(load_rig(first), load_rig_covariance(first))
            title = "imgcal rig"
        else:
            found = read_foreign_rig(self.source, self.source_format)
            title = format_named(found.format).title
            rig = in_millimetres(found, where, self.unit, self.distance)
        if self.cameras:
            left_out = {*rig.names} - {*self.cameras}
            rig, sizes = selected(rig, self.cameras), {name: sizes[name] for name in sizes if name not in left_out}
        return with_image_sizes(rig, where, sizes), title

    def _written(self, made: Written) -> list[Path]:
        return [self.out / name if name else self.out for name in made.files]

    def _write(self, made: Written) -> None:
        """In one step; the source must survive."""
        for path in self._written(made):
            for source in self.source:
                if path.exists() and source.exists() and (path.samefile(source) or path.parent.samefile(source)):
                    raise InputError(f"--out: {path} is what SOURCE holds, expected another place")
        if "" in made.files:
            write_bytes(self.out, made.files[""])
            return
        if self.out.exists() and not self.out.is_dir():
            raise InputError(f"--out: found the file {self.out}, expected a folder: this format has several files")
        names = list(made.files)
        with publishing(self.out, names, mark=names[0]) as folder:
            for name, content in made.files.items():
                write_bytes(folder / name, content)


def _size(text: str) -> tuple[str, tuple[int, int]]:
    """`1280x720` or `NAME=1280x720`."""
    name, _, size = text.rpartition("=")
    match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", size)
    if match is None or not int(match[1]) or not int(match[2]):
        raise InputError(f"--image-size: found {shortened(text)!r}, expected WIDTHxHEIGHT or NAME=WIDTHxHEIGHT")
    return name, (int(match[1]), int(match[2]))
