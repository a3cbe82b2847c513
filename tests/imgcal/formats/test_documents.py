import time
from pathlib import Path

import pytest

from imgcal.errors import InputError
from imgcal.formats import parse_xml
from imgcal.formats.documents import parse_document, read_document
from imgcal.io import read_bytes
from imgcal.io.names import MOST_BYTES

HERE = Path("file")


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("a: 1\nb: [1, 2]\n", "yaml", {"a": 1, "b": [1, 2]}),
        ("%YAML:1.0\n---\nM: !!opencv-matrix\n   rows: 1\n   dt: d\n", "yaml", {"M": {"rows": 1, "dt": "d"}}),
        ("# remark\n\n[cam_0]\nname = 'a'\n", "toml", {"cam_0": {"name": "a"}}),
        ("CreationDate = 2023-03-31T09:56:43\n[cameras.0]\nx = 1\n", "toml", None),
        ("[\"Miqus (1)\"]\nname = 'a'\n", "toml", {"Miqus (1)": {"name": "a"}}),
        ("[cameras.'a: b, c']  # first\nx = 1\n", "toml", {"cameras": {"a: b, c": {"x": 1}}}),
        ('"f(x)" = 1\n', "toml", {"f(x)": 1}),
        ('["a", "b"]', "json", ["a", "b"]),
        ("[('a', 1)]", "python", [("a", 1)]),
        ('{"a": [1]}', "json", {"a": [1]}),
        ('[{"a": 1}]', "json", [{"a": 1}]),
        ("# remark\n{'a': [1, 2,], 'b': b'xyz'}", "python", {"a": [1, 2], "b": b"xyz"}),
    ],
)
def test_a_text_is_what_it_begins_with(text: str, kind: str, value: object) -> None:
    document = parse_document(text.encode(), HERE)
    assert document.kind == kind
    assert value is None or document.value == value


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-le", "utf-16-be"])
def test_xml_in_every_encoding(encoding: str) -> None:
    text = '<?xml version="1.0" encoding="UTF-16LE"?>\n<a x="1"><b>é</b><b/></a>'
    root = parse_document(text.encode(encoding), HERE).value
    assert (root.tag, root.attributes, [child.text for child in root.all("b")]) == ("a", {"x": "1"}, ["é", ""])


BOMB = "<!DOCTYPE a [<!ENTITY l 'lol'>" + "".join(f"<!ENTITY l{n} '{'&l;' * 10}'>" for n in range(9)) + "]><a>&l8;</a>"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (BOMB.encode(), "XML entity"),
        (b"<!DOCTYPE a [<!ENTITY e SYSTEM 'file:///etc/passwd'>]><a>&e;</a>", "XML entity"),
        (b"<a>" * 100_000, "deeper"),
        (b"<a>" + b"<b/>" * 400_000 + b"</a>", "more XML elements"),
        (b"<a><b></a>", "not valid XML in line 1"),
        (b"{" * 100_000, "not valid JSON"),
        (b"[" * 100_000, "not valid JSON"),
        (b"{'a': " + b"-" * 100_000 + b"1}", "not valid JSON"),
        (b"{'a': " + b"(" * 150 + b"1" + b")" * 150 + b"}", "not valid JSON"),
        (b"{'a': __import__('os')}", "not valid JSON"),
        (b"{'a': 9**9**9}", "not valid JSON"),
        (b"a = " + b"[" * 100_000, "not valid TOML"),
        (b"a" + b".a" * 5000 + b" = 1", "TOML key"),
        (b"a = " + b"7" * 5000, "not valid TOML"),
        (b"a = 1\n" * 400_000, "characters of TOML"),
        (b"a: &a [*a]", "alias"),
        (b"a: !!python/object:os.system x", "tag"),
        (b"\x00\x01\x02\x03" * 10, "binary"),
        (b"\xff\xfe<\x00a", "not utf-16"),
    ],
)
def test_what_is_meant_badly_ends_in_one_line(content: bytes, said: str) -> None:
    started = time.monotonic()
    with pytest.raises(InputError, match=said):
        parse_document(content, HERE)
    assert time.monotonic() - started < 120  # a machine that is busy with other things


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "large.yaml"
    with open(path, "wb") as file:
        file.truncate(MOST_BYTES + 1)
    with pytest.raises(InputError, match="expected at most"):
        read_document(path)
    with pytest.raises(InputError, match="expected a file"):
        read_bytes(tmp_path)


def test_an_xml_without_anything() -> None:
    with pytest.raises(InputError, match="no element found"):
        parse_xml("", "file")
