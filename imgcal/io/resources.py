"""Files that ship with the package: reference rigs, objects and sample captures."""

from __future__ import annotations

from pathlib import Path

from imgcal.errors import InputError

SAMPLE = "sample"
"""What the names of shipped captures begin with, before a colon."""


def data_path(*parts: str) -> Path:
    """Find a file or folder of the shipped data, for example `data_path("rigs", "O10.yaml")`.

    Convention: an installed wheel carries the data as `imgcal/data`; a checkout has `data/` beside the package. The
    returned path need not exist.
    """
    package = Path(__file__).resolve().parents[1]
    inside = package / "data"
    return (inside if inside.is_dir() else package.parent / "data").joinpath(*parts)


def shipped_names(kind: str, suffix: str) -> tuple[str, ...]:
    """List the bare names of what is shipped: `shipped_names("rigs", ".yaml")` holds "O10".

    Examples:
        >>> shipped_names("rigs", ".yaml")
        ('O10', 'O6', 'T4', 'U7', 'room10')
    """
    return tuple(sorted(path.stem for path in data_path(kind).glob(f"*{suffix}")))


def sample_path(path: str | Path) -> Path:
    """Replace the name of a shipped sample capture by its folder; other paths stay as they are.

    Args:
        path: `sample:NAME`, or a path.

    Examples:
        >>> sample_path("sample:O10").name, str(sample_path("my_capture"))
        ('O10', 'my_capture')

    Raises:
        InputError: there is no sample of this name.
    """
    prefix, colon, name = str(path).partition(":")
    if prefix != SAMPLE or not colon:
        return Path(path)
    names = sorted(folder.name for folder in data_path("samples").glob("*"))
    if name not in names:
        raise InputError(f"{path}: no such sample, expected {' or '.join(f'{SAMPLE}:{known}' for known in names)}")
    return data_path("samples", name)
