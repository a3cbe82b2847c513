"""Names that a user typed: near misses, sorting, and the shipped rigs, objects, models and sample captures."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable
from pathlib import Path

from imgcal.errors import InputError
from imgcal.messages import shorten

SAMPLE = "sample"
"""What the names of shipped captures begin with, before a colon."""
MOST_NAMES = 8  # that a message lists
MODEL, SUFFIX = "model.safetensors", ".safetensors"  # what `imgcal train` calls a network in the folder of a run
IN_SAMPLE = {"rigs": "rig.yaml", "objects": "object.csv"}
"""Files of a sample capture, by the kind of shipped data that each of them is."""
MOST_BYTES = 2**26  # of a file of values
LONGEST_NAME = 200  # bytes: file systems end at 255, and something is put behind


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


def is_shipped(name: str) -> bool:
    """Tell whether this is the name of a shipped rig, object or sample.

    Examples:
        >>> is_shipped("O10"), is_shipped("sample:O10"), is_shipped("rig.yaml")
        (True, True, False)
    """
    shipped = (*shipped_names("rigs", ".yaml"), *shipped_names("objects", ".csv"))
    return name in shipped or name.startswith(f"{SAMPLE}:")


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


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Make a sort key in which "2" comes before "10"; equal numbers ("1", "01") stay apart."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)], name


def snapshot_name(stem: str, camera: str) -> str:
    """Name a frame's snapshot by its file name, without the camera's own name at either end, as recorders put it there.

    Cameras called by numbers alone are left: those may be part of a date or a count.

    Examples:
        >>> snapshot_name("cam01_0002", "cam01"), snapshot_name("0002-CAM01", "cam01"), snapshot_name("1_2", "1")
        ('0002', '0002', '1_2')
    """
    if not any(letter.isalpha() for letter in camera):
        return stem
    own = re.escape(camera)
    return re.sub(rf"^{own}[ _.-]+(?=.)|(?<=.)[ _.-]+{own}$", "", stem, count=1, flags=re.IGNORECASE)


def nearest(name: str, known: Iterable[str]) -> str:
    """Suggest the known name that was probably meant: `, nearest: cam01`, or nothing if none is near."""
    names = {candidate.lower(): candidate for candidate in known}
    matches = difflib.get_close_matches(name.lower(), names, n=1)
    return f", nearest: {names[matches[0]]}" if matches else ""


def is_file_name(name: str) -> bool:
    """Tell whether the name of a camera or a snapshot can be a file name, which stays in its folder, and a CSV cell."""
    sound = name.isprintable() and name == name.strip() and not name.startswith(".") and not set(name) & set("/\\")
    return sound and 0 < len(name.encode()) <= LONGEST_NAME


def title_from_name(path: Path) -> str:
    """Make a title from a file name, which need not be text."""
    name = "".join(c if c.isprintable() else "?" for c in path.stem)
    return name[:LONGEST_NAME]


def check_regular(path: Path) -> None:
    """Raise `InputError` at a folder, a device or a pipe: reading one may wait for ever."""
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: found a folder, device or pipe, expected a file")


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """Read a regular file of a bounded size.

    Raises:
        InputError: it is none, cannot be read, or is larger.
    """
    check_regular(path)
    try:
        if path.stat().st_size > most:
            raise InputError(f"{path}: found {path.stat().st_size:,} bytes, expected at most {most:,}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def model_file(path: str | Path) -> Path:
    """Find a trained network: a file, the folder of a training run, or the bare name of a shipped one.

    Returns:
        A path that may not exist; reading it reports that.

    Raises:
        InputError: a folder without a trained network.
    """
    path = Path(path)
    if path.is_dir():
        if not (path / MODEL).is_file():
            raise InputError(f"{path}: found a folder without {MODEL}, expected that of a training run")
        return path / MODEL
    if not path.exists() and str(path) in shipped_names("models", SUFFIX):
        return data_path("models", str(path) + SUFFIX)
    return path


def shipped_networks() -> str:
    """List the shipped networks, and say what has more of them where those for whole rigs are not installed."""
    names = shipped_names("models", SUFFIX)
    installed = any(name.startswith("points-") for name in names)
    more = "" if installed else "; those for whole rigs are in imgcal-models (in a clone: pip install ./data/models)"
    return f"a file, the folder of a training run, or one of {', '.join(names)}{more}"


def model_name(path: Path) -> str:
    """Name a network by its file, or by the folder where a training run has put it."""
    return title_from_name(path.absolute().parent if path.name == MODEL else path)


def find_file(path: str | Path, kind: str, suffix: str, other: str | None = None) -> Path:
    """Find a file by its path or, when there is none, by the bare name of a shipped one.

    Args:
        path: a path, a name such as "O10", or that of a sample capture, such as "sample:O10", for the file in it.
        kind: the folder of the shipped data, "rigs" or "objects".
        suffix: of the shipped files.
        other: a name that is known, and no file.

    Raises:
        InputError: neither exists.
    """
    sample = sample_path(path)
    path = sample / IN_SAMPLE[kind] if sample != Path(path) and kind in IN_SAMPLE else Path(path)
    if path.is_file():
        return path
    shipped = shipped_names(kind, suffix)
    if str(path) in shipped:
        return data_path(kind, str(path) + suffix)
    check_regular(path)
    some = difflib.get_close_matches(path.stem, shipped, n=MOST_NAMES, cutoff=0.3) or shipped[:MOST_NAMES]
    names = shipped if len(shipped) <= MOST_NAMES else [*some, f"... {len(shipped)} in all"]
    near = nearest(path.stem, [*shipped, *([other] if other else [])])
    nor = f"nor {other}, nor" if other else "nor"
    raise InputError(f"{path}: no such file, {nor} one of the shipped {kind} ({', '.join(names)}){near}")


def require_left_out(path: Path, without: Collection[str], found: Collection[str]) -> None:
    """Refuse to leave out a camera that is not there, which may be misspelt.

    Raises:
        InputError: names the first one.
    """
    missing = next((camera for camera in without if camera not in found), None)
    if missing is not None:
        raise InputError(f"{path}: found no camera {shorten(missing)} to leave out, neither here nor in the rig")
