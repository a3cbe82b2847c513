"""Text of messages: how quotations, names and values are shortened."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from typing import Any

MOST_QUOTED = 200  # characters of a file's or another program's text
LONGEST = 1000  # characters of a message


def shorten(text: str) -> str:
    """Shorten a name or a table cell to a readable length."""
    return text if len(text) <= 40 else text[:37] + "..."


def quote(text: str) -> str:
    """Shorten a quotation from another program, or a whole value, to a readable length."""
    return text if len(text) <= MOST_QUOTED else text[: MOST_QUOTED - 3] + "..."


def plural(count: int, noun: str) -> str:
    """Write a count with its noun: `1 camera`, `1,200 cameras`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def with_article(noun: str) -> str:
    """Put the indefinite article before a noun: `a camera`, `an object`."""
    return f"{'an' if noun[:1].lower() in 'aeio' else 'a'} {noun}"


def round_to(value: float, digits: int) -> str:
    """Write a number with some significant digits, but no exponent from 1e-4 to 1e15.

    Examples:
        >>> round_to(2237.4, 3), round_to(12.0, 1), round_to(0.0314, 2)
        ('2240', '10', '0.031')
    """
    return f"{float(f'{value:.{digits}g}'):.15g}"


def plus_minus(value: float, sigma: float, digits: int = 3) -> str:
    """Write a value with its standard deviation: `127 +- 10`."""
    return f"{round_to(value, digits)} +- {round_to(sigma, 1)}"


def list_names(names: Iterable[str]) -> str:
    """Join names by commas; a long list shows only the first few and the total."""
    whole = list(names)
    shown = [shorten(name) for name in whole]
    if len(", ".join(shown)) <= MOST_QUOTED:
        return ", ".join(shown)
    return f"{', '.join(shown[: MOST_QUOTED // 50])}, ... ({len(whole)} in all)"


def name_several(noun: str, names: Iterable[str]) -> str:
    """Put a noun before names: `camera a`, `cameras a, b`."""
    whole = list(names)
    return f"{noun}{'s' if len(whole) > 1 else ''} {list_names(whole)}"


def name_cameras(names: Iterable[str]) -> str:
    """Name cameras in a sentence: `camera a`, `cameras a, b`."""
    return name_several("camera", names)


def one_line(message: str) -> str:
    """Make a message safe for one line of a terminal: no line breaks, no control characters, limited length."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(message.split()))
    return text if len(text) <= LONGEST else f"{text[: LONGEST - MOST_QUOTED - 3]}...{text[-MOST_QUOTED:]}"


def brief(value: Any) -> str:
    """Write a value for people: tensors and arrays as type and shape, long tuples as their first and last entry."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{str(value.dtype).removeprefix('torch.')}{tuple(value.shape)}"
    if isinstance(value, tuple) and len(value) > 4:
        return f"({brief(value[0])}, ..., {brief(value[-1])}: {len(value)})"
    return repr(value)


def brief_repr(self: Any) -> str:
    """Serve as the `__repr__` of a dataclass of tensors: shapes instead of walls of numbers."""
    parts = (f"{field.name}={brief(getattr(self, field.name))}" for field in fields(self) if field.repr)
    return f"{type(self).__name__}({', '.join(parts)})"
