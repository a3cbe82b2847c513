"""YAML to plain values: bounded in depth and size, without recursion, and with JSON types only.

PyYAML's own composer recurses in C (a hundred thousand brackets end the process), and it copies what merge keys name.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NoReturn

import yaml

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
                _fail(
                    f"found the alias *{event.anchor} of nothing, or of what it is itself a part of", event.start_mark
                )
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
            _fail(f"found more than {MOST_DEPTH} levels, one within the other", event.start_mark)
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
                _fail("found a merge key `<<` of something else than mappings", mark)
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
            _fail(f"found more than {MOST_VALUES:,} values, with what aliases and merge keys repeat", mark)

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
