"""Numbers and time stamps of a file, replaced where they stand; every other byte stays."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from imgcal.formats.documents import decode, parse_document
from imgcal.formats.foreign_rig import FormatError
from imgcal.formats.source import COLMAP_FILES
from imgcal.formats.spans import Keys, Node, Span, locate, numbers_in

EXACT_DIGITS = 15  # a number with this many digits was written in full
LEAST_DIGITS = 12  # of a number in the place of one that shows none, such as 0 or 1500
WIDEST = 17  # decimals; a smaller number is written with an exponent
NUMBER_PARTS = re.compile(r"([-+]?)(\d*)(\.?)(\d*)(?:([eE])([-+]?)(\d+))?")
STAMP_KEY = re.compile(
    r"(?i)@?(created|calibration[_ -]?(time|date)|(calibrated|created)[_ -]?(at|on)|"
    r"date[_ -]?time[_ -]?(calibrated|created)|timestamp|date|datetime)"
)
STAMP_FORMS = (
    "%Y-%m-%dT%H:%M:%S.%f", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%d %H:%M:%S.%f", "%Y-%m-%d %H:%M:%S", "%Y-%m-%d",
    "%Y-%m-%dT%H:%M:%S.%fZ", "%Y-%m-%dT%H:%M:%SZ", "%Y.%m.%d %H:%M:%S", "%Y/%m/%d %H:%M:%S", "%Y%m%d_%H%M%S",
    "%a %b %d %H:%M:%S %Y", "%d.%m.%Y %H:%M:%S", "%Y-%m-%d, %H:%M:%S",
)  # fmt: skip
DATE_PARTS = {
    "@Year": "year", "@Month": "month", "@Day": "day", "@Hour": "hour", "@Minute": "minute", "@Second": "second",
}  # fmt: skip


@dataclass(frozen=True)
class Change:
    """Numbers that are to stand in a file."""

    keys: Keys
    before: Sequence[float]  # as the reader has understood them; what stays the same is not touched
    after: Sequence[float]
    first: int = 0  # how many other numbers of the value come before


class TextFile:
    """A text of values, and the spans that are to be replaced."""

    def __init__(self, content: bytes, path: Path) -> None:
        """Find where the values stand.

        Raises:
            InputError: it is no calibration in text.
            FormatError: it is written in a way that cannot be followed.
        """
        self.name = path.name
        self.text, self.encoding, self.mark = decode(content, path)
        self.kind = "rows" if path.name in COLMAP_FILES else parse_document(content, path).kind
        try:
            self.root = locate(self.text, self.kind)
        except ValueError as error:
            raise FormatError(f"{self.name}: cannot find its values: {error}") from error
        if self.mark + self.text.encode(self.encoding) != content:
            raise FormatError(f"{self.name}: its text does not survive decoding and encoding")

    def patch(self, changes: Sequence[Change], digits: int) -> bytes:
        """The file with other numbers, each in the form of the one in its place.

        Args:
            changes: what is to stand where.
            digits: how many a number has at least; 0 = as many as the one in its place.

        Raises:
            FormatError: a value holds other numbers than it should.
        """
        wanted: dict[Span, tuple[float, float]] = {}
        groups: list[tuple[str | int, list[Span]]] = []  # by the last key: what is written alike
        for change in changes:
            if all(map(_is_near, change.before, change.after)):
                continue
            node = self.root.at(change.keys)
            spans = numbers_in(self.text, node.span, self.kind) if node is not None else []
            spans = spans[change.first : change.first + len(change.after)]
            if len(spans) != len(change.after):
                where = ".".join(map(str, change.keys))
                raise FormatError(
                    f"{self.name}: {where}: found {len(spans)} plain numbers, expected {len(change.after)}"
                )
            groups.append((change.keys[-1], spans))
            for span, before, after in zip(spans, change.before, change.after, strict=True):
                if wanted.setdefault(span, (before, after))[1] != after:
                    where = ".".join(map(str, change.keys))
                    raise FormatError(
                        f"{self.name}: {where}: one value in the file stands for several cameras: write it out for each"
                    )
        tokens = {span: self.text[slice(*span)] for span in wanted}
        new: dict[Span, str] = {}
        for key in {key for key, _ in groups}:
            spans = [span for other, group in groups if other == key for span in group]
            style = number_style([tokens[span] for span in spans])
            for span in spans:
                before, after = wanted[span]
                if not _is_same(tokens[span], before, after):
                    new[span] = write_like(tokens[span], after, style, digits)
        return self._replace(new)

    def _replace(self, new: dict[Span, str]) -> bytes:
        pieces, at = [], 0
        for (start, end), token in sorted(new.items()):
            pieces += [self.text[at:start], token]
            at = end
        return self.mark + "".join([*pieces, self.text[at:]]).encode(self.encoding)

    def stamp(self, now: datetime) -> tuple[bytes, list[str], list[str]]:
        """The file with `now` in the place of its times of calibration, in their own forms.

        Returns:
            The content, what was replaced, and the values that look like times in no known form.
        """
        new: dict[Span, str] = {}
        replaced, left = [], []
        for keys, node in self.root.walk():
            key, text = str(keys[-1]) if keys else "", self.text[slice(*node.span)].strip().strip("\"'")
            if key in DATE_PARTS and (parent := self.root.at(keys[:-1])) and _is_date(parent) and text.isdigit():
                new[node.span] = f"{getattr(now, DATE_PARTS[key]):0{len(text) if text[0] == '0' else 1}d}"
                replaced.append("Date")
            elif STAMP_KEY.fullmatch(key) and text:
                made = _stamp_like(text, now)
                if made is None:
                    left.append(f"{key.lstrip('@')} ({text[:40]})")
                    continue
                start = self.text.index(text, node.span[0])
                new[(start, start + len(text))] = made
                replaced.append(key.lstrip("@"))
        return self._replace(new), list(dict.fromkeys(replaced)), list(dict.fromkeys(left))


def _is_near(before: float, after: float) -> bool:
    return math.isclose(before, after, rel_tol=1e-13)


def _is_same(token: str, before: float, after: float) -> bool:
    """Tell whether a number that stands there need not be touched, though its digits are rounded."""
    found = float(token.replace("_", ""))
    return found == after or (_is_near(before, after) and math.isclose(found, before, rel_tol=1e-4, abs_tol=1e-4))


def _is_date(node: Node) -> bool:
    return {"@Year", "@Month", "@Day"} <= node.children.keys()


def _stamp_like(text: str, now: datetime) -> str | None:
    for form in STAMP_FORMS:
        try:
            datetime.strptime(text, form)
        except ValueError:
            continue
        moment = now.astimezone(UTC) if form.endswith("Z") else now
        made = moment.strftime(form)
        return made[:-3] if form.endswith("%f") and len(text.rpartition(".")[2]) == 3 else made
    return None


@dataclass(frozen=True)
class Style:
    """How the numbers of one kind are written in a file."""

    shortest: bool = False  # in full, with as many digits as each needs
    usual: str | None = None  # a number that shows how many decimals there are, for those that show none


def number_style(tokens: Sequence[str]) -> Style:
    """Tell from the numbers that stand there how such numbers are written."""
    shown = [token for token in tokens if not _is_short(token)]
    forms = {(bool(_parts(token)[4]), len(_parts(token)[3])) for token in shown}
    kinds = {has_exponent for has_exponent, _ in forms}
    if len(forms) > len(kinds) and any(_digits(token) >= EXACT_DIGITS for token in shown):
        return Style(shortest=True)
    return Style(usual=max(shown, key=lambda token: len(_parts(token)[3]), default=None))


def write_like(token: str, value: float, style: Style | None = None, digits: int = 0) -> str:
    """Write a number in the form of another one: fixed or with an exponent, with as many decimals.

    Args:
        token: the number that stands there.
        value: the number that is to stand there.
        style: of such numbers in the file.
        digits: significant digits that there are to be at least.

    Examples:
        >>> write_like("-0.046183", 0.0512345678), write_like("1.20E-08", -3.14159e-9)
        ('0.051235', '-3.14E-09')
        >>> write_like("0", 0.25, Style(usual="1.125"))
        '0.250'
    """
    style = style or Style()
    _, _, point, decimals, e, *_ = _parts(token)
    if value == int(value) and not decimals and not e and abs(value) < 1e15:
        return f"{int(value)}{point}"
    if style.shortest:
        return _with_point(repr(float(value)))
    if _is_short(token):
        token, digits = (style.usual, digits) if style.usual else (token, max(digits, LEAST_DIGITS))
    sign, _, _, decimals, e, e_sign, exponent = _parts(token)
    plus = "+" if sign == "+" and value >= 0 else ""
    places = len(decimals)
    if e:
        mantissa, _, power = f"{value:.{max(places, digits - 1)}e}".partition("e")
        shown = "-" if int(power) < 0 else "+" if e_sign else ""
        return f"{plus}{mantissa}{e}{shown}{abs(int(power)):0{len(exponent)}d}"
    if digits and value:
        places = max(places, digits - 1 - math.floor(math.log10(abs(value))))
    if digits and places > max(WIDEST, len(decimals)):
        return _with_point(f"{value:.{digits - 1}e}")
    return f"{plus}{value:.{places}f}"


def _is_short(token: str) -> bool:
    """Tell whether a number shows nothing of how others are written: 0, 1500, 0.0, 1."""
    _, _, _, decimals, e, *_ = _parts(token)
    return not e and len(decimals) <= 1


def _digits(token: str) -> int:
    """Significant digits that a number shows."""
    _, whole, _, decimals, *_ = _parts(token)
    return len((whole + decimals).lstrip("0"))


def _parts(token: str) -> tuple[str, ...]:
    """Sign, whole part, point, decimals, e, its sign, and exponent of a number."""
    match = NUMBER_PARTS.fullmatch(token.replace("_", ""))
    assert match is not None
    return tuple(part or "" for part in match.groups())


def _with_point(text: str) -> str:
    """A number with an exponent has a point, too: without, it is a text to YAML."""
    mantissa, e, power = text.partition("e")
    return text if "." in mantissa or not e else f"{mantissa}.0e{power}"


def patch_bytes(content: bytes, changes: Sequence[Change]) -> bytes:
    """The same for a binary file: `keys` is the offset of little-endian doubles."""
    made = bytearray(content)
    for change in changes:
        (offset,) = change.keys
        for place, (before, after) in enumerate(zip(change.before, change.after, strict=True)):
            if not _is_near(before, after):
                struct.pack_into("<d", made, int(offset) + 8 * (change.first + place), after)
    return bytes(made)
