"""What a user points at: a file, a few files, or a folder that holds a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from imgcal.errors import InputError
from imgcal.formats.documents import Document, Element, read_document
from imgcal.messages import list_names, quote

MOST_FILES = 1000
SUFFIXES = frozenset(
    (".yaml", ".yml", ".toml", ".json", ".xml", ".txt", ".mcal", ".xcp", ".cameramodel", ".calib", ".qca")
)
PARTNERS = (("intrinsics", "extrinsics"), ("intri", "extri"))
"""Two files that make up one calibration: if one is given, the other is read, too."""

COLMAP_FILES = frozenset(
    f"{stem}.{suffix}" for stem in ("cameras", "images", "rigs", "frames") for suffix in ("txt", "bin")
)


class Source:
    """Files whose content is read when a format asks for it."""

    def __init__(self, paths: Sequence[Path], rig: str | None = None) -> None:
        """Look at paths; nothing is read yet.

        Args:
            paths: files and folders.
            rig: which one is meant where the files hold several.

        Raises:
            InputError: a path that does not exist, a device, or one that is given twice.
        """
        self.rig = rig
        self.paths = tuple(paths)
        self.where = quote(", ".join(map(str, paths)))
        self.alone = False  # one file, whose faults the user must hear about
        self.files: list[Path] = []
        for number, path in enumerate(paths):
            if path in paths[:number]:
                raise InputError(f"{path}: found it twice, expected each file once")
            if path.is_dir():
                self.files += _list_inside(path)
            elif path.is_file():
                self.alone = len(paths) == 1
                self.files += _add_partner(path)
            else:
                raise InputError(f"{path}: {'found a device or pipe' if path.exists() else 'no such file or folder'}")
        self.title = paths[0].stem if paths[0].is_file() else paths[0].resolve().name
        self.unreadable: list[InputError] = []

    @cached_property
    def documents(self) -> list[Document]:
        """What stands in the files; those that are no text of a known kind are passed over where there are others."""
        found = []
        for path in self.files:
            if not self.alone and path.suffix.lower() not in SUFFIXES:
                continue
            if path.name in COLMAP_FILES:
                continue
            try:
                found.append(read_document(path))
            except InputError as error:
                self.unreadable.append(error)
        return found

    @property
    def mappings(self) -> list[tuple[Document, dict[str, Any]]]:
        """The documents that are keys and values."""
        return [(document, document.value) for document in self.documents if isinstance(document.value, dict)]

    def merge(self) -> dict[str, Any]:
        """The keys and values of all documents together; the first one that has a key counts."""
        together: dict[str, Any] = {}
        for _, values in self.mappings:
            for key, value in values.items():
                together.setdefault(key, value)
        return together

    def roots(self, *tags: str) -> list[Element]:
        """The XML documents, of all names or of some."""
        roots = [one.value for one in self.documents if isinstance(one.value, Element)]
        return [root for root in roots if not tags or root.tag in tags]

    def find_file(self, name: str) -> Path | None:
        """The file of a name, if it is there."""
        return next((path for path in self.files if path.name == name), None)

    def of_document(self, document: Document) -> Source:
        """A source of one of its documents alone, without what it may be one calibration with."""
        part = Source([document.path], self.rig)
        part.files, part.documents = [document.path], [document]
        return part

    def describe(self) -> str:
        """Its files in a few words, for messages."""
        return list_names(path.name for path in self.files) or "an empty folder"


def _list_inside(folder: Path) -> list[Path]:
    try:
        found = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror or error}") from error
    if len(found) > MOST_FILES:
        raise InputError(f"{folder}: found {len(found):,} files, expected the folder of one calibration")
    return found


def _add_partner(path: Path) -> list[Path]:
    """The file, and what it is one calibration with."""
    if path.name in COLMAP_FILES:
        return [path, *(one for one in _list_inside(path.parent) if one.name in COLMAP_FILES and one != path)]
    for pair in PARTNERS:
        for mine, other in (pair, pair[::-1]):
            partner = path.with_name(path.name.replace(mine, other, 1))
            if mine in path.name and partner != path and partner.is_file():
                return [path, partner]
    return [path]
