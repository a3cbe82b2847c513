"""Damage files as a bad disk, a careless user or an attacker would. Every choice comes from `random`."""

from __future__ import annotations

import gzip
import json
import re
import struct
import zlib
from collections.abc import Callable
from random import Random

Mutation = Callable[[bytes, Random], bytes]

VALUES = (
    "0", "-0.0", "-1", "1e-150", "1e-320", "1e308", "-1e308", "1e200", "nan", ".nan", ".inf", "-inf", "inf", "''", "~",
    "", "true", "false", "[]", "{}", "[1, 2]", "{a: 1}", "9" * 30, "7" * 5000, "0x10", "1_000", "2147483648", "1:30",
    "18446744073709551616", "!!int ''", "!!bool x", "!!timestamp x", "!!map [a]", "!!python/object:os.system x", "*a",
    "&a 1", "- 1", "null", "'text'", "2026-11-21", "\u0663", "1e5", "0.1", "7", "1e9", "16777217", "[" * 2000,
)  # fmt: skip
NAMES = (
    "../../x", "/tmp/x", "..", ".", "", " ", "a" * 300, "a/b", "a\\b", "\x1b[31mred", "\u202egnp.x", "CON", "a,b", '"',
    "'", "<script>alert(1)</script>", "{{ 7 * 7 }}", "\x00", "\U0001f4a5", "cam01", "00000", "%s%n", "$(id)", "-o", "é",
)  # fmt: skip
WHOLE = (0, 1, 2, 3, 7, 8, 255, 256, 32000, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)


def mutated(content: bytes, kind: str, random: Random) -> bytes:
    """Damage the content of a file according to its suffix `kind`: usually once, sometimes several times."""
    for _ in range(random.choice((1, 1, 1, 2, 5))):
        content = random.choice(MUTATIONS.get(kind, BYTES))(content, random)
    return content


def flip(content: bytes, random: Random) -> bytes:
    """Flip some bits."""
    changed = bytearray(content)
    for _ in range(random.choice((1, 1, 4, 64)) if changed else 0):
        changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
    return bytes(changed)


def cut(content: bytes, random: Random) -> bytes:
    """Truncate the content."""
    return content[: random.randrange(len(content) + 1)]


def replace_range(content: bytes, random: Random) -> bytes:
    """Replace a part with something else or nothing, or repeat it."""
    first = random.randrange(len(content) + 1)
    last = min(len(content), first + random.choice((0, 1, 4, 50, 1000)))
    new = random.choice(
        (b"", b"\0" * 8, b"\xff" * 8, random.randbytes(16), content[first:last] * random.choice((2, 50)))
    )
    return content[:first] + new + content[last:]


def numbers_in_binary(content: bytes, random: Random) -> bytes:
    """Overwrite a binary number, usually near the start, where headers are."""
    layout = random.choice(("<H", ">H", "<I", ">I", "<Q", ">Q"))
    end = min(len(content), random.choice((64, 400, len(content) + 1)))
    if end < 8:
        return content
    place = random.randrange(end - 7)
    number = random.choice(WHOLE) % 2 ** (8 * struct.calcsize(layout))
    return content[:place] + struct.pack(layout, number) + content[place + struct.calcsize(layout) :]


def other_value(content: bytes, random: Random) -> bytes:
    """Replace a number in a text."""
    found = list(re.finditer(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?", content))
    if not found:
        return content
    match = random.choice(found)
    return content[: match.start()] + random.choice(VALUES).encode() + content[match.end() :]


def other_name(content: bytes, random: Random) -> bytes:
    """Replace a word in a text with a nasty one or with another word of the text."""
    found = list(re.finditer(rb"[A-Za-z_][A-Za-z_0-9]*", content))
    if not found:
        return content
    match = random.choice(found)
    new = random.choice((random.choice(NAMES).encode(), random.choice(found)[0], b"\xff\xfe", b"\xed\xb3\xbf"))
    return content[: match.start()] + new + content[match.end() :]


def lines(content: bytes, random: Random) -> bytes:
    """Drop, repeat, swap, shuffle or truncate lines."""
    rows = content.split(b"\n")
    first, second = random.randrange(len(rows)), random.randrange(len(rows))
    match random.randrange(6):
        case 0:
            del rows[first]
        case 1:
            rows.insert(second, rows[first])
        case 2:
            rows[first], rows[second] = rows[second], rows[first]
        case 3:
            tail = rows[1:]
            random.shuffle(tail)
            rows = rows[:1] + tail
        case 4:
            rows = [rows[0], *(row for row in rows[1:] for _ in range(3))]
        case 5:
            rows = rows[: 1 + first]
    return b"\n".join(rows)


def columns(content: bytes, random: Random) -> bytes:
    """Swap two columns of a CSV, or set one to the same value in every row."""
    rows = [row.split(b",") for row in content.split(b"\n")]
    width = len(rows[0])
    first, second = random.randrange(width), random.randrange(width)
    value = random.choice((*VALUES, *NAMES)).encode() if random.random() < 0.5 else None
    for number, row in enumerate(rows):
        if len(row) == width and value is None:
            row[first], row[second] = row[second], row[first]
        elif len(row) == width and number:
            row[first] = value or b""
    return b"\n".join(b",".join(row) for row in rows)


def structure(content: bytes, random: Random) -> bytes:
    """Insert a construct that is hard to parse into a YAML text."""
    nasty = random.choice(
        (
            b"[" * 5000,
            b"{a: " * 5000,
            b"a: &a [*a]\n",
            b"<<: *a\n",
            b"? [a]\n: b\n",
            b"1: 2\n",
            b"--- \n",
            b"%YAML 9.9\n",
        )
    )
    rows = content.split(b"\n")
    rows.insert(random.randrange(len(rows) + 1), nasty)
    return b"\n".join(rows)


def markup(content: bytes, random: Random) -> bytes:
    """Insert a construct that is hard to parse into an XML text, in UTF-16 if the text is."""
    nasty = random.choice(
        (
            "<!DOCTYPE a [<!ENTITY l 'lol'><!ENTITY m '&l;&l;&l;&l;&l;&l;&l;&l;'>]>",
            "<!DOCTYPE a [<!ENTITY e SYSTEM 'file:///etc/passwd'>]>",
            "<a>" * 5000,
            "&l;",
            "</Cameras>",
            "<Camera/>" * 400,
            "<![CDATA[",
        )
    )
    wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    new = nasty.encode("utf-16-le" if wide else "utf-8")
    ends = [match.end() for match in re.finditer(rb">\0" if wide else rb">", content)]
    place = random.choice([2 if wide else 0, *ends])
    return content[:place] + new + content[place:]


def png_chunks(content: bytes, random: Random) -> bytes:
    """Damage a chunk of a PNG and correct its checksum."""
    position, chunks = 8, []
    while position + 12 <= len(content):
        length = int.from_bytes(content[position : position + 4], "big")
        chunks.append((content[position + 4 : position + 8], content[position + 8 : position + 8 + length]))
        position += 12 + length
    if not chunks:
        return content
    number = random.randrange(len(chunks))
    kind, inside = chunks[number]
    match random.randrange(4):
        case 0:
            chunks[number] = kind, random.choice((flip, cut, replace_range, numbers_in_binary))(inside, random)
        case 1:
            del chunks[number]
        case 2:
            chunks.insert(number, (random.choice((b"iCCP", b"tRNS", b"zTXt", b"acTL", b"PLTE", b"ABCD")), inside))
        case 3 if kind == b"IDAT":
            pixels = random.choice((b"", bytes(10**6), random.randbytes(1000)))
            chunks[number] = kind, zlib.compress(pixels)
    packed = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return content[:8] + b"".join(packed)


def compressed(content: bytes, random: Random) -> bytes:
    """Damage the content of a gzip file."""
    try:
        inside = gzip.decompress(content)
    except (OSError, EOFError, zlib.error):
        return content
    return gzip.compress(random.choice(CSV)(inside, random), mtime=0)


def tensors(content: bytes, random: Random) -> bytes:
    """Damage the header of a safetensors file: a tensor's entry, or one of the metadata texts."""
    length = int.from_bytes(content[:8], "little")
    try:
        header = json.loads(content[8 : 8 + length])
        texts = header["__metadata__"]
    except (ValueError, KeyError, TypeError):
        return content
    key = random.choice(sorted(header))
    if key == "__metadata__" or random.random() < 0.7:
        name = random.choice(sorted(texts))
        damage = random.choice((other_value, other_name, lines, cut, deep))
        texts[name] = damage(str(texts[name]).encode(), random).decode(errors="replace")
    else:
        field = random.choice(("dtype", "shape", "data_offsets"))
        header[key][field] = random.choice(("F64", "X", [], [-1], [2**40], [0, 2**63], [3, 1], None, 7, {}))
    packed = json.dumps(header).encode()
    return struct.pack("<Q", len(packed)) + packed + content[8 + length :]


def deep(content: bytes, random: Random) -> bytes:
    """Nest brackets too deeply."""
    return random.choice((b"[" * 100_000, b'{"a":' * 300 + b"1" + b"}" * 300, b"[" + content + b"]"))


BYTES: tuple[Mutation, ...] = (flip, cut, replace_range, numbers_in_binary)
CSV: tuple[Mutation, ...] = (other_value, other_value, other_name, lines, columns, flip, cut, replace_range)
TEXT: tuple[Mutation, ...] = (other_value, other_value, other_value, other_name, lines, flip, cut, replace_range, deep)
XML: tuple[Mutation, ...] = (other_value, other_value, other_name, lines, markup, flip, cut, replace_range)
MUTATIONS: dict[str, tuple[Mutation, ...]] = {
    **dict.fromkeys((".toml", ".json", ".txt", ".cameramodel"), TEXT),
    **dict.fromkeys((".xml", ".mcal", ".xcp"), XML),
    ".yml": (other_value, other_value, other_value, other_name, lines, structure, flip, cut, replace_range),
    ".yaml": (other_value, other_value, other_value, other_name, lines, structure, flip, cut, replace_range),
    ".csv": CSV,
    ".gz": (compressed, compressed, compressed, *BYTES),
    ".png": (png_chunks, png_chunks, png_chunks, *BYTES),
    ".safetensors": (tensors, tensors, tensors, *BYTES),
}
