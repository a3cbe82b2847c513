"""Reading YAML strictly (duplicate keys are errors of one line) and writing it readably."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from imgcal.errors import InputError
from imgcal.io.names import check_regular
from imgcal.io.validation import Model, validate
from imgcal.io.yaml_values import read_values
from imgcal.messages import shorten

MOST_BYTES = 2**26
INSTEAD = {
    ("imgcal-rig/1", "imgcal-cameras/1"): ": these cameras have no places yet; imgcal calibrate finds them where the "
    "file is given as --cameras instead of --rig (in Python: load_cameras, calibrate_from_scratch)",
}
"""What to do with a file of another format (the second) than the one that was expected."""
WORD = re.compile(r"[^\W\d_]{2}['\u2019\w]*[,.;:]?")
SHARE_OF_PROSE = 0.2
"""Of the lines of a text for people, at least, have four words in a row; few of a damaged file of values do."""
_BaseDumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class Flow(list[Any]):
    """A list that is written on one line: `[1.0, 2.0]`."""


class FlowMap(dict[str, Any]):
    """A mapping that is written on one line: `{a: 1.0, b: 2.0}`."""


def read_yaml(path: Path, model: type[Model], file_format: str, entry_names: Mapping[str, str] | None = None) -> Model:
    """Read and validate a YAML file.

    Args:
        path: the file.
        model: what the file holds; it has a field `format`.
        file_format: the required value of the key `format`, such as "imgcal-rig/1".
        entry_names: for keys that hold a list of named records, what one record is called: {"cameras": "camera"}.

    Raises:
        InputError: one line with the file, what was found and what was expected.
    """
    return record_from_yaml(_content(path), str(path), model, file_format, entry_names)


def record_from_yaml(
    content: bytes, where: str, model: type[Model], file_format: str, entry_names: Mapping[str, str] | None = None
) -> Model:
    """Do the work of `read_yaml` on the text of a file; errors begin with `where`."""
    return validate(_check_format(content, where, file_format), model, where, entry_names)


def read_yaml_mapping(path: Path, file_format: str) -> dict[str, Any]:
    """Read the plain values of a YAML file with a known `format`.

    Raises:
        InputError: one line with the file, what was found and what was expected.
    """
    return _check_format(_content(path), str(path), file_format)


def is_prose(text: str) -> bool:
    r"""Tell whether a text is sentences rather than values: a README, say.

    Examples:
        >>> is_prose("imgcal\n======\nThis tool recalibrates several cameras.\n")
        True
        >>> is_prose("format: imgcal-rig/1\nname: a rig of ours\ncameras: []\n")
        False
    """
    lines = [line for line in text.splitlines() if line.strip()]
    return SHARE_OF_PROSE * len(lines) < sum(map(_has_sentence, lines))


def _has_sentence(line: str) -> bool:
    """Tell whether four words in a row are in a line. One pass: lines of damaged files are long."""
    row = 0
    for piece in line.split(" "):
        row = row + 1 if WORD.fullmatch(piece.strip("()*`\"'!?")) else 0
        if row == 4:
            return True
    return False


def looks_like(text: str) -> str:
    """Guess what an unreadable text is, by its first line."""
    first = next((line.strip() for line in text.splitlines() if line.strip()), "")
    return f"text for people (it begins `{shorten(first)}`)"


def _check_format(content: bytes, where: str, file_format: str) -> dict[str, Any]:
    try:
        values = _parse(content, where)
    except InputError:
        text = content.decode(errors="replace")
        if not is_prose(text):
            raise
        raise InputError(
            f"{where}: found {looks_like(text)}, expected a file that starts with `format: {file_format}`"
        ) from None
    if not isinstance(values, dict):
        raise InputError(f"{where}: found {_what(values)}, expected a mapping that starts with `format: {file_format}`")
    if values.get("format") != file_format:
        found = f"`format: {reprlib.repr(values['format'])}`" if "format" in values else "no key `format`"
        instead = INSTEAD.get((file_format, str(values.get("format"))), "")
        raise InputError(f"{where}: found {found}, expected `format: {file_format}`{instead}")
    return values


def parse_yaml(text: str, where: str) -> Any:
    """Read a value from YAML text that does not come from a file; errors begin with `where`."""
    try:
        return read_values(text.encode(errors="replace"))
    except yaml.YAMLError as error:
        raise InputError(f"{where}: found {reprlib.repr(text)}, expected a value in YAML") from error


def parse_foreign_yaml(content: bytes, where: str, mapping_tags: frozenset[str] = frozenset()) -> Any:
    """Read the plain values of a YAML file of another tool, within the same bounds; errors begin with `where`.

    Args:
        content: encoded text. A first line `%YAML:1.0` (OpenCV's) or `%YAML 1.2` is passed over.
        where: what errors begin with.
        mapping_tags: tags that its mappings may have, as `tag:yaml.org,2002:opencv-matrix`.
    """
    return _parse(re.sub(rb"\A(\xef\xbb\xbf)?%YAML[^\n]*\n", b"", content), where, mapping_tags)


def yaml_text(content: dict[str, Any]) -> str:
    """Write plain values as YAML in the given order; floats in their shortest exact form."""
    return yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=2**30, allow_unicode=True
    )


class _Dumper(_BaseDumper):
    """Flow style for `Flow` and `FlowMap`, block style for the rest."""


# 1e-5 is a number to the reader: the writer puts quotes around a name that looks like it.
_Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+0123456789.")
)
_Dumper.add_representer(Flow, lambda d, v: d.represent_sequence("tag:yaml.org,2002:seq", v, flow_style=True))
_Dumper.add_representer(FlowMap, lambda d, v: d.represent_mapping("tag:yaml.org,2002:map", v.items(), flow_style=True))


def _content(path: Path) -> bytes:
    check_regular(path)
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path}: found {path.stat().st_size:,} bytes, expected at most {MOST_BYTES:,}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _parse(content: bytes, where: str, mapping_tags: frozenset[str] = frozenset()) -> Any:
    if len(content) > MOST_BYTES:
        raise InputError(f"{where}: found {len(content):,} bytes, expected at most {MOST_BYTES:,}")
    try:
        return read_values(content, mapping_tags)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f" in line {mark.line + 1}" if mark is not None else ""
        raise InputError(f"{where}: not valid YAML{line}: {error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise InputError(f"{where}: not a YAML text file: {str(error).splitlines()[0]}") from error


def _what(content: Any) -> str:
    return "an empty file" if content is None else f"{type(content).__name__} {reprlib.repr(content)}"
