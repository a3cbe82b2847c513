"""Where values stand in the text of a file: the spans of YAML, TOML, JSON, XML and Python literals, by their keys."""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat

import yaml

Span = tuple[int, int]  # characters, the second excluded
Keys = tuple[str | int, ...]

NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")
COMMENT = re.compile(r"#[^\n]*")
ATTRIBUTE = re.compile(r"\s+([^\s=<>\"'/]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")
TOML_HEADER = re.compile(r"\[{1,2}([^\]\n]*)\]{1,2}")
TOML_KEY = re.compile(
    r"((?:[\w-]+|\"(?:\\.|[^\"\\])*\"|'[^']*')(?:\s*\.\s*(?:[\w-]+|\"(?:\\.|[^\"\\])*\"|'[^']*'))*)\s*=\s*"
)
TOML_PART = re.compile(r"[\w-]+|\"(?:\\.|[^\"\\])*\"|'[^']*'")
TOML_STRING = re.compile(r'"""(?s:\\.|.)*?"""|\'\'\'(?s:.)*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'')


@dataclass
class Node:
    """A value of a document: its span and, of mappings and lists, what is in it."""

    span: Span
    children: dict[str | int, Node] = field(default_factory=dict)

    def at(self, keys: Keys) -> Node | None:
        """The value that keys lead to."""
        node: Node | None = self
        for key in keys:
            node = None if node is None else node.children.get(key)
        return node

    def walk(self, keys: Keys = ()) -> Iterator[tuple[Keys, Node]]:
        """All values in it that hold no others, with their keys."""
        if not self.children:
            yield keys, self
        for key, child in self.children.items():
            yield from child.walk((*keys, key))


def locate(text: str, kind: str) -> Node:
    """Find the spans of all values of a text that has been read before.

    Args:
        text: of the file, without a byte order mark.
        kind: of the document: yaml, toml, json, xml, python, rows.

    Raises:
        ValueError: the text is written in a way that is not followed here.
    """
    try:
        if kind == "xml":
            return _xml(text)
        if kind == "toml":
            return _toml(text)
        if kind == "rows":
            return _rows(text)
        if kind == "yaml":
            return _yaml(text)
        return _literal(text)
    except (yaml.YAMLError, expat.ExpatError, SyntaxError, RecursionError, MemoryError, KeyError) as error:
        raise ValueError(str(error).partition("\n")[0]) from error


def numbers_in(text: str, span: Span, kind: str) -> list[Span]:
    """Find the numbers in a value, comments aside."""
    start, end = span
    value = text[start:end]
    if kind != "xml":
        value = COMMENT.sub(lambda match: " " * len(match[0]), value)
    return [(start + match.start(), start + match.end()) for match in NUMBER.finditer(value)]


def _rows(text: str) -> Node:
    """Lines by their number, from 1."""
    root, at = Node((0, len(text))), 0
    for number, line in enumerate(re.split(r"(?<=\n)|(?<=\r)(?!\n)", text), start=1):
        root.children[number] = Node((at, at + len(line)))
        at += len(line)
    return root


def _yaml(text: str) -> Node:
    # As long as before, and a comment: OpenCV's first line is no YAML.
    plain = re.sub(r"\A%YAML[^\n]*", lambda match: "#" * len(match[0]), text)
    root = yaml.compose(plain, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return _make_node(root) if root is not None else Node((0, 0))


def _make_node(node: Any) -> Node:
    made = Node((node.start_mark.index, node.end_mark.index))
    if isinstance(node, yaml.MappingNode):
        made.children = {key.value: _make_node(value) for key, value in node.value if isinstance(key, yaml.ScalarNode)}
    elif isinstance(node, yaml.SequenceNode):
        made.children = {place: _make_node(value) for place, value in enumerate(node.value)}
    return made


def _literal(text: str) -> Node:
    """JSON is close enough to Python's literals for Python's parser to say where its values are."""
    inner = text.lstrip()
    offset = len(text) - len(inner)
    inner = inner.rstrip()
    lines = re.split(r"(?<=\n)|(?<=\r)(?!\n)", inner)
    starts = [offset]
    for line in lines:
        starts.append(starts[-1] + len(line))

    def place(line: int, column: int) -> int:
        found = lines[line - 1]
        return starts[line - 1] + (column if found.isascii() else len(found.encode()[:column].decode(errors="replace")))

    def of(node: Any) -> Node:
        made = Node((place(node.lineno, node.col_offset), place(node.end_lineno, node.end_col_offset)))
        if isinstance(node, ast.Dict):
            made.children = {
                key.value: of(value) for key, value in zip(node.keys, node.values, strict=True)
                if isinstance(key, ast.Constant) and isinstance(key.value, str | int)
            }  # fmt: skip
        elif isinstance(node, ast.List | ast.Tuple):
            made.children = {place: of(value) for place, value in enumerate(node.elts)}
        return made

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)
        return of(ast.parse(inner, mode="eval").body)


def _xml(text: str) -> Node:
    """Elements by their number in the order of the document and, below the root, by their names."""
    # One byte a character, so that the parser counts characters.
    plain = re.sub(r"\A\s*<\?xml[^>]*\?>", lambda match: " " * len(match[0]), re.sub(r"[^\x00-\x7f]", "x", text))
    root = Node((0, len(text)))
    waiting: list[tuple[Node, int]] = [(root, 0)]
    count = 0
    parser = expat.ParserCreate("utf-8")

    def start(tag: str, _: dict[str, str]) -> None:
        nonlocal count
        count += 1
        begin = int(parser.CurrentByteIndex)
        at = begin + 1 + len(tag)
        node = Node((at, at))
        while match := ATTRIBUTE.match(text, at):
            group = 2 if match[2] is not None else 3
            node.children[f"@{match[1]}"] = Node(match.span(group))
            at = match.end()
        root.children[count] = node
        if len(waiting) > 1:
            waiting[-1][0].children.setdefault(tag, node)
        else:
            root.children[tag] = node
        waiting.append((node, text.find(">", at) + 1))

    def end(_: str) -> None:
        node, inside = waiting.pop()
        node.span = (inside, max(inside, int(parser.CurrentByteIndex)))

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.Parse(plain.encode(), True)
    return root


def _toml(text: str) -> Node:
    root = Node((0, len(text)))
    table, at = root, 0
    while at < len(text):
        if text[at].isspace():
            at += 1
        elif text[at] == "#":
            at = _line_end(text, at)
        elif header := TOML_HEADER.match(text, at):
            table = _table(root, _parts(header[1]), header)
            at = header.end()
        elif key := TOML_KEY.match(text, at):
            *outer, last = _parts(key[1])
            end = _toml_value(text, key.end())
            _table(table, outer, None).children[last] = Node((key.end(), end))
            at = end
        else:
            raise ValueError(f"found {text[at : at + 20]!r}, expected a key of TOML")
    return root


def _parts(key: str) -> list[str]:
    """A dotted key, taken apart."""
    return [part[1:-1] if part[0] in "\"'" else part for part in TOML_PART.findall(key)]


def _table(node: Node, parts: list[str], header: re.Match[str] | None) -> Node:
    for number, part in enumerate(parts, start=1):
        child = node.children.setdefault(part, Node((0, 0)))
        if header is not None and header[0].startswith("[[") and number == len(parts):
            child = child.children.setdefault(len(child.children), Node((0, 0)))
        elif child.children and all(isinstance(key, int) for key in child.children):
            child = child.children[len(child.children) - 1]
        node = child
    return node


def _toml_value(text: str, at: int) -> int:
    """Where a value ends: at the end of its line, or of the brackets that it opens."""
    depth, end = 0, at
    while at < len(text):
        if string := TOML_STRING.match(text, at):
            at = end = string.end()
        elif text[at] == "#":
            if not depth:
                return end
            at = _line_end(text, at)
        elif text[at] == "\n" and not depth:
            return end
        else:
            depth += (text[at] in "[{") - (text[at] in "]}")
            end = at + 1 if not text[at].isspace() else end
            at += 1
    return end


def _line_end(text: str, at: int) -> int:
    end = text.find("\n", at)
    return len(text) if end < 0 else end
