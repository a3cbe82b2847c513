"""Small vector drawings as text: they follow the page's light or dark colours, print sharply and need no script."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

Array = NDArray[np.float64]

LONGEST_NAME = 16  # characters
DOTS_PER_PATH = 200
"""Dots of one path do not add up where they overlap; many short paths do, and show density."""


@dataclass(frozen=True)
class Axes:
    """A plotting area inside a drawing; `left`, `right`, `top`, `bottom` are its edges in the drawing's units."""

    left: float
    right: float
    top: float
    bottom: float
    x_range: tuple[float, float]  # data at left, right
    y_range: tuple[float, float]  # data at bottom, top

    def x(self, value: Array | float) -> Array:
        """Place data along x."""
        low, high = self.x_range
        return np.asarray(self.left + (np.asarray(value) - low) / (high - low) * (self.right - self.left))

    def y(self, value: Array | float) -> Array:
        """Place data along y."""
        low, high = self.y_range
        return np.asarray(self.bottom + (np.asarray(value) - low) / (high - low) * (self.top - self.bottom))


def drawing(width: float, height: float, label: str, *parts: str, kind: str = "") -> Markup:
    """Wrap elements into an `<svg>` with a name for those who cannot see it."""
    body = "".join(parts)
    return Markup(
        f'<svg class="chart {kind}" viewBox="0 0 {number(width)} {number(height)}" role="img" '
        f'aria-label="{escape(label)}" style="max-width:{number(1.5 * width)}px">{body}</svg>'
    )


def text(x: float, y: float, content: str, *, kind: str = "tick", anchor: str = "middle") -> str:
    """Write escaped text."""
    return f'<text class="{kind}" x="{number(x)}" y="{number(y)}" text-anchor="{anchor}">{escape(content)}</text>'


def line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    """Draw a straight line."""
    return f'<path class="{kind}" d="M{number(x1)} {number(y1)}L{number(x2)} {number(y2)}"/>'


def box(x: float, y: float, width: float, height: float, kind: str, title: str = "") -> str:
    """Draw a rectangle; `title` is shown on hovering."""
    tip = f"<title>{escape(title)}</title>" if title else ""
    return (
        f'<rect class="{kind}" x="{number(x)}" y="{number(y)}" width="{number(max(width, 0.0))}" '
        f'height="{number(max(height, 0.0))}">{tip}</rect>'
    )


def dots(x: Array, y: Array, kind: str, per_path: int = DOTS_PER_PATH) -> str:
    """Draw round dots, as lines of no length with round ends: a dozen bytes each."""
    steps = [f"M{number(a)} {number(b)}h0" for a, b in zip(x, y, strict=True)]
    paths = ("".join(steps[i : i + per_path]) for i in range(0, len(steps), per_path))
    return "".join(f'<path class="{kind}" d="{path}"/>' for path in paths)


def polyline(x: Array, y: Array, kind: str) -> str:
    """Draw a line through points."""
    steps = "L".join(f"{number(a)} {number(b)}" for a, b in zip(x, y, strict=True))
    return f'<path class="{kind}" d="M{steps}"/>'


def grid(axes: Axes, x_title: str = "", y_title: str = "", *, count: int = 5, log_x: bool = False) -> str:
    """Draw grid lines, tick labels and axis titles. With `log_x` the data along x are decimal logarithms."""
    parts = []
    for value in _decades(*axes.x_range) if log_x else ticks(*axes.x_range, count):
        x = float(axes.x(value))
        parts.append(line(x, axes.top, x, axes.bottom, "grid"))
        parts.append(text(x, axes.bottom + 15, f"{10**value:g}" if log_x else tick_label(value)))
    if y_title:
        for value in ticks(*axes.y_range, count):
            y = float(axes.y(value))
            parts.append(line(axes.left, y, axes.right, y, "grid"))
            parts.append(text(axes.left - 6, y + 3.5, tick_label(value), anchor="end"))
        middle = (axes.top + axes.bottom) / 2
        parts.append(
            f'<text class="tick" transform="translate(11 {number(middle)}) rotate(-90)" text-anchor="middle">'
            f"{escape(y_title)}</text>"
        )
    if x_title:
        parts.append(text((axes.left + axes.right) / 2, axes.bottom + 31, x_title))
    return "".join(parts)


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Choose round numbers between two limits, in either order."""
    low, high = min(low, high), max(low, high)
    raw = 0.7 * max((high - low) / count, 1e-12)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * 0.999)
    return [round(i * step, 12) for i in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def tick_label(value: float) -> str:
    """Write a tick, with a true minus sign."""
    return f"{value:g}".replace("-", "\N{MINUS SIGN}")


def number(value: float) -> str:
    """Write a coordinate, to a tenth of a unit."""
    rounded = f"{value:.1f}".removesuffix(".0")
    return "0" if rounded == "-0" else rounded


def group_digits(count: int) -> str:
    """Write a large number with narrow spaces between thousands."""
    return f"{count:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def pixels(value: float) -> str:
    """Write an error in pixels, to about three digits."""
    digits = 0 if value >= 100 else 1 if value >= 10 else 2 if value >= 1 else 3
    return f"{value:.{digits}f}" if value >= 0.01 or value == 0 else f"{value:.2g}"


def shorten_name(name: str) -> str:
    """Cut a long name for a narrow place."""
    return name if len(name) <= LONGEST_NAME else name[: LONGEST_NAME - 1] + "\N{HORIZONTAL ELLIPSIS}"


def _decades(low: float, high: float) -> list[float]:
    """Decimal logarithms of the ticks of a logarithmic axis: 1, 10, ...; with 2 and 5 on a short one."""
    factors = (1, 2, 5) if high - low < 2.5 else (1,)
    return [
        decade + math.log10(factor)
        for decade in range(math.floor(low), math.ceil(high) + 1)
        for factor in factors
        if low - 1e-9 <= decade + math.log10(factor) <= high + 1e-9
    ]
