"""Files of other tools as plain values: YAML, TOML, JSON, XML and Python literals, distinguished by their first bytes.

Whatever is read comes from outside: size, depth and number of values are bounded, and no type but plain ones is made.
"""

from __future__ import annotations

import ast
import re
import tomllib
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from imgcal.errors import InputError
from imgcal.io import is_prose, looks_like, parse_foreign_yaml, read_bytes, read_json
from imgcal.messages import quote

MOST_TOML = 2**20  # the parser needs a square of what a hostile one nests; a camera has half a kilobyte
MOST_DEPTH = 32
MOST_ELEMENTS = 300_000

OPENCV_TAGS = frozenset(f"tag:yaml.org,2002:opencv-{kind}" for kind in ("matrix", "nd-matrix", "sparse-matrix"))
QUOTED = r"\"(?:[^\"\\]|\\.)*\"|'[^']*'"
TABLE = re.compile(rf"\[{{1,2}}(?:[\w\s./-]|{QUOTED})+\]{{1,2}}[ \t]*(#.*)?$")
ASSIGNMENT = re.compile(rf"(?:[\w.-]|{QUOTED})+[ \t]*=")


@dataclass
class Element:
    """A node of an XML document."""

    tag: str
    attributes: dict[str, str]
    children: list[Element] = field(default_factory=list)
    text: str = ""
    number: int = 0  # in the order of the document, from 1

    def find(self, tag: str) -> Element | None:
        """The first child of a name."""
        return next((child for child in self.children if child.tag == tag), None)

    def all(self, tag: str) -> list[Element]:
        """All descendants of a name, in order."""
        found: list[Element] = []
        waiting = [self]
        while waiting:
            one = waiting.pop()
            found += [one] if one.tag == tag else []
            waiting.extend(reversed(one.children))
        return found


@dataclass(frozen=True)
class Document:
    """A file and what stands in it."""

    path: Path
    kind: str  # yaml, toml, json, xml, python
    value: Any  # plain values; of XML its root Element


def read_document(path: Path) -> Document:
    """Read a text file of any of the kinds.

    Raises:
        InputError: it is none, cannot be read, or is larger or deeper than any calibration.
    """
    return parse_document(read_bytes(path), path)


def parse_document(content: bytes, path: Path) -> Document:
    """Do the work of `read_document` on what a file holds."""
    text, _, _ = decode(content, path)
    try:
        return _parse(text, path)
    except InputError:
        if not is_prose(text):
            raise
        expected = "`format: imgcal-rig/1`, or the calibration of another tool in YAML, TOML, JSON or XML"
        raise InputError(f"{path}: found {looks_like(text)}, expected {expected}") from None


def _parse(text: str, path: Path) -> Document:
    first = next((line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    if first.startswith("<"):
        return Document(path, "xml", parse_xml(text, str(path)))
    if first.startswith("%YAML"):
        return Document(path, "yaml", parse_foreign_yaml(text.encode(), str(path), OPENCV_TAGS))
    if TABLE.match(first) or ASSIGNMENT.match(first):
        return Document(path, "toml", _toml(text, str(path)))
    if first.startswith(("{", "[")):
        return _json_or_python(text, path)
    return Document(path, "yaml", parse_foreign_yaml(text.encode(), str(path), OPENCV_TAGS))


def parse_xml(text: str, where: str) -> Element:
    """Read an XML text without entities of its own, of bounded depth and size.

    Raises:
        InputError: one line with the line and what is wrong there.
    """
    # The encoding has been taken care of, whatever the declaration says.
    text = re.sub(r"\A\s*<\?xml[^>]*\?>", "", text)
    builder = _Builder(where)
    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.EntityDeclHandler = builder.entity
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    try:
        parser.Parse(text.encode("utf-8", errors="replace"), True)
    except expat.ExpatError as error:
        raise InputError(f"{where}: not valid XML in line {error.lineno}: {expat.ErrorString(error.code)}") from error
    if builder.root is None:
        raise InputError(f"{where}: found an empty XML file")
    return builder.root


class _Builder:
    """Makes elements of what the parser sees."""

    def __init__(self, where: str) -> None:
        self.where = where
        self.root: Element | None = None
        self.open: list[tuple[Element, list[str]]] = []
        self.count = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self.count += 1
        if self.count > MOST_ELEMENTS or len(self.open) >= MOST_DEPTH:
            raise InputError(f"{self.where}: found more XML elements, or deeper ones, than any calibration has")
        element = Element(tag, attributes, number=self.count)
        if self.open:
            self.open[-1][0].children.append(element)
        else:
            self.root = element
        self.open.append((element, []))

    def end(self, _: str) -> None:
        element, pieces = self.open.pop()
        element.text = "".join(pieces)

    def data(self, text: str) -> None:
        if self.open:
            self.open[-1][1].append(text)

    def entity(self, *_: Any) -> None:
        raise InputError(f"{self.where}: found an XML entity, expected plain elements")


def decode(content: bytes, path: Path) -> tuple[str, str, bytes]:
    """Decode the text of a file, line ends as they are.

    Returns:
        The text, its encoding, and the byte order mark before it: mark + text.encode(encoding) is the content.

    Raises:
        InputError: it is no text, or not in the encoding that its first bytes say.
    """
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        encoding, mark = "utf-16-le" if content[0] == 0xFF else "utf-16-be", content[:2]
    elif content[:4] == b"<\0?\0" or content[:4] == b"\0<\0?":
        encoding, mark = "utf-16-le" if content[0] else "utf-16-be", b""
    else:
        encoding, mark = "utf-8", content[:3] if content.startswith(b"\xef\xbb\xbf") else b""
        if b"\0" in content[:4096]:
            raise InputError(f"{path}: found binary data, expected the text of a calibration")
    try:
        return content[len(mark) :].decode(encoding), encoding, mark
    except UnicodeDecodeError:
        if encoding != "utf-8":
            raise InputError(f"{path}: found text that is not {encoding[:6]}, as its first bytes say") from None
        return content.decode("latin-1"), "latin-1", b""  # comments of old tools; numbers and names are ASCII


def _toml(text: str, where: str) -> Any:
    if len(text) > MOST_TOML:
        raise InputError(f"{where}: found {len(text):,} characters of TOML, expected at most {MOST_TOML:,}")
    longest = max(map(len, re.findall(r"(?m)^\s*\[*([\w.\"'-]*)", text)), default=0)
    if longest > 2000:
        raise InputError(f"{where}: found a TOML key of {longest} characters")
    try:
        value = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{where}: not valid TOML: {quote(str(error))}") from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"{where}: not valid TOML: nested too deeply, or a number of too many digits") from error
    return value


def _json_or_python(text: str, path: Path) -> Document:
    """JSON, or a Python literal, which looks alike."""
    try:
        return Document(path, "json", read_json(text))
    except ValueError as error:
        problem = quote(str(error))
    try:
        return Document(path, "python", _literal(text))
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {problem}") from error


def _literal(text: str) -> Any:
    """A Python literal: brackets within bounds, so that the parser is not led into the depth."""
    depth = deepest = 0
    bare = re.sub(r"(?s)'(?:\\.|[^'\\])*'|\"(?:\\.|[^\"\\])*\"|#[^\n]*", "", text)
    for bracket in re.findall(r"[][(){}]", bare):
        depth += 1 if bracket in "[({" else -1
        deepest = max(deepest, depth)
    if deepest > MOST_DEPTH or re.search(r"[-+~]{20}|(?:\bnot\b\s*){5}|\*|\bfor\b|\blambda\b", bare):
        raise ValueError("not a literal")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)
        return ast.literal_eval(text.strip())
