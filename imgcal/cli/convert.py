"""`imgcal convert`: the calibration of another tool to ours, ours to another tool's, or one tool's to another's."""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path

from imgcal.cli import arguments
from imgcal.errors import InputError
from imgcal.formats import (
    FORMATS,
    OURS,
    Files,
    ForeignRig,
    Format,
    convert_rig,
    fill_image_sizes,
    find_format,
    from_camera_rig,
    in_millimetres,
    is_foreign,
    read_foreign_rig,
    select_cameras,
    write_into,
)
from imgcal.io import load_rig_covariance, publishing, read_rig, write_bytes
from imgcal.messages import list_names, plural, shorten, with_article


class Convert(arguments.Convert):
    """Run `imgcal convert`."""

    def run(self) -> None:
        """Read, convert, verify, write."""
        if not self.source:
            expected = f"imgcal convert SOURCE --out {self.out.name} (a file, a folder, or a shipped rig's name)"
            raise InputError(f"SOURCE: found none, expected a calibration to convert: {expected}")
        if self.into:
            self._write_back()
            return
        to = self._target()
        rig, title = self._read()
        print(f"{title}: {plural(len(rig.cameras), 'camera')}; frame: {rig.frame}")
        for note in rig.notes:
            print(f"note: {note}")
        made = convert_rig(rig, to, self.out.stem, self.fit_limit, self.out_unit, hold_distortion=self.hold_distortion)
        for note in made.notes:
            print(f"note: {note}")
        if self.to is None and (named := _format_named(self.out.stem)):
            other = f"--to {named.name} writes {with_article(named.title)}"
            print(f"note: --out ends in {self.out.suffix}, so an imgcal rig file is written; {other}")
        written = self._write(made.files)
        models = f"{made.between_models:.2g} px" if made.between_models > 1e-6 else "the same"
        print(
            f"wrote {list_names(map(str, written))} ({'imgcal rig file' if to == OURS else to}); re-read: worst "
            f"difference {made.round_trip:.1e} px on {made.points} points, lens models {models}"
        )

    def _write_back(self) -> None:
        """Replace the numbers in a copy of the user's own file."""
        self._check_limit()
        self._check_held()
        if self.to == OURS:
            raise InputError("--to: found imgcal, expected the format of the file that --into names")
        rig, _ = self._read()
        made = write_into(
            rig,
            self.into,
            datetime.now(),
            name=self.to,
            original_rig=self.source_rig,
            unit=self.out_unit,
            limit=self.fit_limit,
        )
        for note in made.notes:
            print(f"note: {note}")
        alone = len(made.files) == 1 and not (len(self.into) == 1 and self.into[0].is_dir())
        files = {"": next(iter(made.files.values()))} if alone else made.files
        written = self._write(files)
        where = list_names(map(str, written))
        print(
            f"{made.title}: {plural(len(made.changed), 'camera')} replaced"
            + (f", {plural(len(made.kept), 'camera')} kept" if made.kept else "")
        )
        if made.loss is not None:
            print(
                f"lens models: worst {made.loss.worst:.2g} px, RMS {made.loss.rms:.2g} px (limit {self.fit_limit:g} px)"
            )
        print(f"wrote {where}; re-read: worst difference {made.reread:.1e} px on {made.points} points")

    def _check_held(self) -> None:
        if self.hold_distortion:
            raise InputError("--hold-distortion: needs an imgcal rig file as output (--out rig.yaml)")

    def _check_limit(self) -> None:
        if not 0 < self.fit_limit < float("inf"):
            raise InputError(f"--fit-limit: found {self.fit_limit}, expected pixels > 0")

    def _target(self) -> str:
        to = self.to if self.to is not None else OURS if self.out.suffix in (".yaml", ".yml") else None
        if to is None:
            able = ", ".join(one.name for one in FORMATS if one.write is not None)
            expected = f"one of imgcal, {able}, or --into the original"
            raise InputError(f"--to: cannot tell the format from {self.out.name}; expected {expected}")
        if to != OURS:
            find_format(to)
            self._check_held()
        self._check_limit()
        return to

    def _read(self) -> tuple[ForeignRig, str]:
        """The rig in millimetres with its image sizes, and what it is called."""
        where = ", ".join(map(str, self.source))
        sizes = dict(map(_size, self.image_size))
        first = self.source[0]
        ours = (
            len(self.source) == 1 and self.source_format in (None, OURS) and not (first.exists() and is_foreign(first))
        )
        if ours:
            if self.unit is not None or self.distance is not None:
                raise InputError(f"{where}: an imgcal rig file is in mm, expected neither --unit nor --distance")
            rig = from_camera_rig(read_rig(first), load_rig_covariance(first))
            title = "imgcal rig"
        else:
            found = read_foreign_rig(self.source, self.source_format, self.source_rig)
            title = find_format(found.format).title
            rig = in_millimetres(found, where, self.unit, self.distance)
        if self.cameras:
            left_out = {*rig.names} - {*self.cameras}
            rig, sizes = (
                select_cameras(rig, self.cameras),
                {name: sizes[name] for name in sizes if name not in left_out},
            )
        return fill_image_sizes(rig, where, sizes), title

    def _write(self, files: Files) -> list[Path]:
        """In one step; the sources must survive."""
        folder = self.out.parent if "" in files else self.out
        written = [folder / name if name else self.out for name in files]
        for path in written:
            for what, source in [*(("SOURCE", one) for one in self.source), *(("--into", one) for one in self.into)]:
                if path.exists() and source.exists() and (path.samefile(source) or path.parent.samefile(source)):
                    raise InputError(f"--out: {path} would overwrite {what}, expected another path")
        if "" in files:
            for path, content in zip(written, files.values(), strict=True):
                write_bytes(path, content)
            return written
        if self.out.exists() and not self.out.is_dir():
            raise InputError(f"--out: found the file {self.out}, expected a folder: this format has several files")
        names = list(files)
        with publishing(self.out, names, mark=names[0]) as folder:
            for name, content in files.items():
                write_bytes(folder / name, content)
        return written


def _format_named(stem: str) -> Format | None:
    """Find the format that the name of a file suggests."""
    words = re.split(r"[^a-z0-9]+", stem.lower())
    return next((one for one in FORMATS if one.write and {one.name, one.stem} & {*words}), None)


def _size(text: str) -> tuple[str, tuple[int, int]]:
    """`1280x720` or `NAME=1280x720`."""
    name, _, size = text.rpartition("=")
    match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", size)
    if match is None or not int(match[1]) or not int(match[2]):
        raise InputError(f"--image-size: found {shorten(text)!r}, expected WIDTHxHEIGHT or NAME=WIDTHxHEIGHT")
    return name, (int(match[1]), int(match[2]))
