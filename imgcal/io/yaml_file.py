"""Reading YAML strictly (duplicate keys are errors of one line) and writing it readably.

Values are built from the parser's events, bounded in depth and size: PyYAML's own composer recurses in C (a hundred
thousand brackets end the process), and it copies what merge keys name.
"""

from __future__ import annotations

import re
import reprlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import yaml

from imgcal.errors import InputError
from imgcal.io.names import MOST_BYTES, read_bytes
from imgcal.io.validation import Model, validate
from imgcal.messages import shorten

# libyaml's parser reads a full covariance in tenths of a second; the pure Python one needs seconds.
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

MOST_DEPTH = 32
MOST_VALUES = 3_000_000  # with everything that aliases and merge keys repeat; a hundred cameras' covariance fits
LONGEST_NUMBER = 1000  # characters; 1:1:1... is one to the base of 60, and takes the square of its length

CORE = "tag:yaml.org,2002:"
SCALARS = frozenset(CORE + name for name in ("str", "int", "float", "bool", "null"))
LIST, MAPPING = frozenset({CORE + "seq"}), frozenset({CORE + "map"})
WHOLE = re.compile(r"[-+]?(0|[1-9][0-9]{0,17})")
DECIMAL = re.compile(r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?")  # YAML 1.2: 1e-5 is one

MERGE = object()  # stands for the key `<<`
Mark = Any  # of PyYAML: where in the text
INSTEAD = {
    ("imgcal-rig/1", "imgcal-cameras/1"): ": these cameras have no poses yet; imgcal calibrate finds them if the "
    "file is given as --cameras instead of --rig (in Python: load_cameras, calibrate_from_scratch)",
}
"""What to do with a file of another format (the second) than the one that was expected."""
WORD = re.compile(r"[^\W\d_]{2}['\u2019\w]*[,.;:]?")
SHARE_OF_PROSE = 0.2
"""Of the lines of a text for people, at least, have four words in a row; few of a damaged file of values do."""
_BaseDumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def read_values(content: bytes, mapping_tags: frozenset[str] = frozenset()) -> Any:
    """Read one YAML document.

    Keys stay text whatever they look like (`false: 0.1`, `1: 2`), and so do dates.

    Args:
        content: encoded text.
        mapping_tags: tags beyond those of JSON that a mapping may have; nothing is made of them.

    Returns:
        dict, list, str, int, float, bool or None.

    Raises:
        yaml.YAMLError: not YAML, a key given twice, a tag of another type, or more than is in any honest file.
    """
    loader = _Loader(content)
    try:
        return _Builder(loader, MAPPING | mapping_tags).document()
    finally:
        loader.dispose()


@dataclass(slots=True)
class _Open:
    """A list or mapping that has begun and not ended."""

    value: list[Any] | dict[str, Any]
    anchor: str | None
    before: int  # values read before it began
    key: Any = None  # of a mapping: the key that waits for its value
    merged: list[dict[str, Any]] | None = None  # of a mapping: what its merge key names


class _Builder:
    """Turns events into values."""

    def __init__(self, loader: Any, mapping_tags: frozenset[str]) -> None:
        self.loader = loader
        self.mapping_tags = mapping_tags
        self.open: list[_Open] = []
        self.anchors: dict[str, tuple[Any, int]] = {}  # value and how many values it holds
        self.count = 0
        self.result: Any = None

    def document(self) -> Any:
        """Read to the end."""
        loader = self.loader
        loader.get_event()  # start of the stream
        if loader.check_event(yaml.StreamEndEvent):
            return None
        loader.get_event()  # start of the document
        while not loader.check_event(yaml.DocumentEndEvent):
            self._take(loader.get_event())
        loader.get_event()
        if not loader.check_event(yaml.StreamEndEvent):
            _fail("found a second document, expected one", loader.peek_event().start_mark)
        return self.result

    def _take(self, event: Any) -> None:
        kind = type(event)
        if kind is yaml.ScalarEvent:
            awaits_key = bool(self.open) and type(self.open[-1].value) is dict and self.open[-1].key is None
            if awaits_key:
                self._begin_pair(event)
                return
            self._count(1, event.start_mark)
            value = self._scalar(event)
            if event.anchor is not None:
                self.anchors[event.anchor] = value, 1
            self._add(value, event.start_mark)
        elif kind is yaml.AliasEvent:
            if event.anchor not in self.anchors:
                _fail(f"found the alias *{event.anchor} without an anchor, or inside its own anchor", event.start_mark)
            value, count = self.anchors[event.anchor]
            self._count(count, event.start_mark)
            self._add(value, event.start_mark)
        elif kind is yaml.MappingStartEvent or kind is yaml.SequenceStartEvent:
            self._begin(event)
        else:
            self._end(event)

    def _begin(self, event: Any) -> None:
        value: list[Any] | dict[str, Any] = {} if isinstance(event, yaml.MappingStartEvent) else []
        _check_tag(event, self.mapping_tags if isinstance(value, dict) else LIST)
        self._check_not_a_key(event.start_mark)
        if len(self.open) == MOST_DEPTH:
            _fail(f"found more than {MOST_DEPTH} nested levels", event.start_mark)
        self.open.append(_Open(value, event.anchor, self.count))
        self._count(1, event.start_mark)

    def _end(self, event: Any) -> None:
        done = self.open.pop()
        for source in done.merged or ():
            assert isinstance(done.value, dict)
            self._count(len(source), event.start_mark)
            for key, value in source.items():
                done.value.setdefault(key, value)
        if done.anchor is not None:
            self.anchors[done.anchor] = done.value, self.count - done.before
        self._add(done.value, event.start_mark)

    def _begin_pair(self, event: Any) -> None:
        within = self.open[-1]
        if event.value == "<<" and event.implicit[0]:
            within.key = MERGE
            return
        if event.value in within.value:
            _fail(f"key `{event.value[:40]}` given twice", event.start_mark)
        within.key = event.value

    def _add(self, value: Any, mark: Mark) -> None:
        """Put a finished value where it belongs."""
        if not self.open:
            self.result = value
            return
        within = self.open[-1]
        if isinstance(within.value, list):
            within.value.append(value)
            return
        self._check_not_a_key(mark)
        if within.key is MERGE:
            sources = value if isinstance(value, list) else [value]
            if not all(isinstance(source, dict) for source in sources):
                _fail("found a merge key `<<` whose value is not a mapping", mark)
            within.merged = [*(within.merged or ()), *sources]
        else:
            within.value[within.key] = value
        within.key = None

    def _check_not_a_key(self, mark: Mark) -> None:
        if self.open and isinstance(self.open[-1].value, dict) and self.open[-1].key is None:
            _fail("found a list, a mapping or an alias as a key, expected text", mark)

    def _count(self, more: int, mark: Mark) -> None:
        self.count += more
        if self.count > MOST_VALUES:
            _fail(f"found more than {MOST_VALUES:,} values, counting what aliases and merge keys repeat", mark)

    def _scalar(self, event: Any) -> Any:
        text: str = event.value
        _check_tag(event, SCALARS)
        if event.tag is None and not event.implicit[0]:
            return text  # in quotes
        if event.tag is None:
            if WHOLE.fullmatch(text):
                return int(text)
            if DECIMAL.fullmatch(text):
                return float(text)
        tag = event.tag or self.loader.resolve(yaml.ScalarNode, text, event.implicit)
        if tag not in SCALARS or tag == CORE + "str":
            return text  # dates, and signs that mean something elsewhere
        try:
            if len(text) > LONGEST_NUMBER:
                raise ValueError
            return self.loader.construct_object(yaml.ScalarNode(tag, text, event.start_mark, event.end_mark))
        except (ValueError, KeyError, IndexError):
            _fail(f"found {text[:40]!r}, expected a value of type {tag.removeprefix(CORE)}", event.start_mark)


def _check_tag(event: Any, allowed: frozenset[str]) -> None:
    if event.tag is not None and event.tag not in allowed:
        tag = event.tag.replace(CORE, "!!")
        _fail(f"found the tag {tag[:40]}, expected plain values without", event.start_mark)


def _fail(problem: str, mark: Mark) -> NoReturn:
    raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


class Flow(list[Any]):
    """A list that is written on one line: `[1.0, 2.0]`."""


class FlowMap(dict[str, Any]):
    """A mapping that is written on one line: `{a: 1.0, b: 2.0}`."""


def read_yaml(path: Path, model: type[Model], file_format: str) -> Model:
    """Read and validate a YAML file.

    Args:
        path: the file.
        model: what the file holds; it has a field `format`.
        file_format: the required value of the key `format`, such as "imgcal-rig/1".

    Raises:
        InputError: one line with the file, what was found and what was expected.
    """
    return record_from_yaml(read_bytes(path), str(path), model, file_format)


def record_from_yaml(content: bytes, where: str, model: type[Model], file_format: str) -> Model:
    """Do the work of `read_yaml` on the text of a file; errors begin with `where`."""
    return validate(_check_format(content, where, file_format), model, where)


def read_yaml_mapping(path: Path, file_format: str) -> dict[str, Any]:
    """Read the plain values of a YAML file with a known `format`.

    Raises:
        InputError: one line with the file, what was found and what was expected.
    """
    return _check_format(read_bytes(path), str(path), file_format)


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
        raise InputError(
            f"{where}: found {_describe(values)}, expected a mapping that starts with `format: {file_format}`"
        )
    if values.get("format") != file_format:
        found = f"`format: {reprlib.repr(values['format'])}`" if "format" in values else "no key `format`"
        instead = INSTEAD.get((file_format, str(values.get("format"))), "")
        raise InputError(f"{where}: found {found}, expected `format: {file_format}`{instead}")
    return values


def parse_yaml(text: str, where: str) -> Any:
    """Read a value from YAML text that does not come from a file; errors begin with `where`.

    Raises:
        InputError: the text is not valid YAML.
    """
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


def _describe(content: Any) -> str:
    return "an empty file" if content is None else f"{type(content).__name__} {reprlib.repr(content)}"
