"""Files that ship with the package: reference rigs, objects and sample captures."""

from __future__ import annotations

from pathlib import Path


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
