"""Plots as SVG inside the page: they take its colours, and stay sharp."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.reporting.html import Html, joined, tag

F64 = NDArray[np.float64]
_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP, _RIGHT = 560, 260, 52, 30, 14, 12


@dataclass(frozen=True)
class Mark:
    """One camera in a plan: where it stands, where it looks, and how to show it.

    Args:
        at, toward: (2,) position and unit direction in the plan (the direction may be shorter).
        kind: a class of the style sheet, "train" or "test".
    """

    name: str
    at: F64
    toward: F64
    kind: str


def curve(points: Sequence[tuple[float, float]], *, label: str, log: bool = False) -> Html:
    """One line over the steps of training; `log` for a logarithmic axis of positive values."""
    kept = [(x, y) for x, y in points if math.isfinite(y) and (y > 0 or not log)]
    if len(kept) < 2:
        return tag("p", "Too few points for a curve.", class_="none")
    xs = np.array([x for x, _ in kept])
    ys = np.array([math.log10(y) if log else y for _, y in kept])
    low, high = float(ys.min()), float(ys.max())
    ticks = _log_ticks(low, high) if log else _ticks(low, high)
    low, high = min(low, ticks[0]), max(high, ticks[-1])
    right = float(xs.max()) or 1.0

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            _LEFT + (_WIDTH - _LEFT - _RIGHT) * x / right,
            _TOP + (_HEIGHT - _TOP - _BOTTOM) * (high - y) / ((high - low) or 1),
        )

    parts = []
    for value in ticks:
        _, y = place(0, value)
        words = f"{10**value:.3g}" if log else f"{value:g}"
        parts.append(tag("line", x1=_LEFT, x2=_WIDTH - _RIGHT, y1=y, y2=y, class_="grid"))
        parts.append(tag("text", words, x=_LEFT - 6, y=y + 4, text_anchor="end"))
    for value in _ticks(0, right):
        x, _ = place(value, low)
        anchor = "end" if x > _WIDTH - 30 else "middle"
        parts.append(tag("text", f"{value:g}", x=x, y=_HEIGHT - 8, text_anchor=anchor))
    line = " ".join(
        f"{a:.1f},{b:.1f}" for a, b in (place(x, y) for x, y in zip(xs, ys, strict=True))
    )
    parts.append(tag("polyline", points=line, class_="curve"))
    return _svg((_WIDTH, _HEIGHT), *parts, label=label)


def plan(
    marks: Sequence[Mark],
    *,
    ball: tuple[F64, float],
    points: F64,
    axes: tuple[str, str],
    label: str,
) -> Html:
    """Cameras seen from one side, with the object's ball in their midst; y goes up.

    Args:
        ball: (2,) centre and radius.
        points: (P, 2) sparse points.
        axes: names of the horizontal and of the vertical axis.
    """
    center, radius = ball
    corners = [mark.at for mark in marks] + [center - radius, center + radius]
    box = np.array(corners)
    low, high = box.min(0), box.max(0)
    middle, half = (low + high) / 2, float((high - low).max()) / 2 * 1.12
    size = 420.0
    scale = size / (2 * half)

    def place(p: F64) -> tuple[float, float]:
        x, y = (p - middle) * scale
        return float(size / 2 + x), float(size / 2 - y)

    x, y = place(center)
    parts = [tag("circle", cx=x, cy=y, r=radius * scale, class_="ball")]
    inside = points[(np.abs(points - middle) < half).all(1)] if len(points) else points
    for point in inside:
        x, y = place(point)
        parts.append(tag("circle", cx=x, cy=y, r=0.8, class_="point"))
    parts += [_frustum(mark, place, half * 0.075) for mark in marks]
    words = (f"{axes[0]} →", f"{axes[1]} ↑")
    parts.append(tag("text", words[0], x=size - 6, y=size - 6, text_anchor="end"))
    parts.append(tag("text", words[1], x=6, y=14))
    return _svg((size, size), *parts, label=label)


def directions(
    photos: Sequence[tuple[str, float, float]], gap: tuple[float, float], *, label: str
) -> Html:
    """Photos round an object: azimuth to the right, height upwards, the widest gap shaded.

    Args:
        photos: name, azimuth from -180 to 180, height from -90 to 90, degrees.
        gap: azimuths where it begins and ends, the end above the beginning.
    """
    lowest = min([height for _, _, height in photos] + [0.0])
    highest = max([height for _, _, height in photos] + [60.0])
    low = max(30 * math.floor(lowest / 30 - 0.1), -90)
    high = min(30 * math.ceil(highest / 30 + 0.1), 90)

    def place(azimuth: float, height: float) -> tuple[float, float]:
        return (
            _LEFT + (_WIDTH - _LEFT - _RIGHT) * (azimuth + 180) / 360,
            _TOP + (_HEIGHT - _TOP - _BOTTOM) * (high - height) / (high - low),
        )

    parts = []
    pieces = [(gap[0], min(gap[1], 180.0)), (-180.0, gap[1] - 360.0)]
    for start, end in pieces:
        if end > start:
            (left, top), (right, bottom) = place(start, high), place(end, low)
            size = {"width": right - left, "height": bottom - top}
            parts.append(tag("rect", x=left, y=top, class_="gap", **size))
    for level in range(low, high + 1, 30):
        _, y = place(0, level)
        parts.append(tag("line", x1=_LEFT, x2=_WIDTH - _RIGHT, y1=y, y2=y, class_="grid"))
        parts.append(tag("text", f"{level}°", x=_LEFT - 6, y=y + 4, text_anchor="end"))
    for turn in range(-180, 181, 60):
        x, _ = place(turn, low)
        anchor = "end" if turn == 180 else "middle"
        parts.append(tag("line", x1=x, x2=x, y1=_TOP, y2=_HEIGHT - _BOTTOM, class_="grid"))
        parts.append(tag("text", f"{turn}°", x=x, y=_HEIGHT - 8, text_anchor=anchor))
    for name, azimuth, height in photos:
        x, y = place(azimuth, height)
        dot = tag("circle", cx=x, cy=y, r=4)
        parts.append(tag("g", tag("title", name), dot, class_="camera train"))
    return _svg((_WIDTH, _HEIGHT), *parts, label=label)


def bars(rows: Sequence[tuple[str, float, str, str]]) -> Html:
    """Horizontal bars: (name, length, words behind it, class of the style sheet)."""
    longest = max((length for _, length, _, _ in rows), default=0) or 1.0
    lines = []
    for name, length, words, kind in rows:
        bar = tag("i", class_=kind, style=f"width:{100 * length / longest:.1f}%")
        lines.append(joined(tag("span", name), tag("span", bar), tag("span", words)))
    return tag("div", *lines, class_="bars")


def _frustum(mark: Mark, place: Callable[[F64], tuple[float, float]], length: float) -> Html:
    """A camera as a small wedge that opens where it looks."""
    across = np.array([-mark.toward[1], mark.toward[0]])
    tip = mark.at
    left, right = (tip + length * (mark.toward + side * 0.5 * across) for side in (1, -1))
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in map(place, (tip, left, right, tip)))
    x, y = place(tip)
    return tag(
        "g",
        tag("title", mark.name),
        tag("polyline", points=text),
        tag("circle", cx=x, cy=y, r=2.2),
        class_=f"camera {mark.kind}",
    )


def _svg(size: tuple[float, float], *parts: Html, label: str) -> Html:
    box = f"0 0 {size[0]:g} {size[1]:g}"
    return tag("svg", joined(*parts), viewBox=box, role="img", aria_label=label, class_="plot")


def _ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers that span the range."""
    span = (high - low) or abs(high) or 1.0
    step: float = 10.0 ** math.floor(math.log10(span))
    for part in (0.2, 0.25, 0.5, 1.0, 2.0):
        if span / (step * part) <= 5:
            step *= part
            break
    first, last = math.floor(low / step + 1e-9), math.floor(high / step + 1e-9)
    return [round(step * i, 10) for i in range(first, last + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """Logarithms of 1, 2 and 5 times powers of ten that span the range."""
    found = [
        math.log10(digit) + power
        for power in range(math.floor(low) - 1, math.ceil(high) + 1)
        for digit in (1, 2, 5)
    ]
    below = max(value for value in found if value <= low)
    above = min(value for value in found if value >= high)
    return [value for value in found if below <= value <= above]
