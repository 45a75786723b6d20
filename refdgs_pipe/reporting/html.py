"""Markup that cannot be broken by what it holds: every plain string is escaped when it enters."""

import html
import re
from typing import TypeAlias

from refdgs_pipe.formatting import printable_lines

Content: TypeAlias = "Html | str"
_VOID = ("img", "input", "meta", "br", "path", "circle", "line", "rect", "polyline", "image")


class Html(str):
    """A string that is markup already."""

    __slots__ = ()


def tag(name: str, /, *children: Content, **attributes: str | int | float | bool | None) -> Html:
    """An element. Plain strings are escaped; attributes that are None or False are left out.

    A trailing underscore in an attribute's name is dropped (`class_`), others become dashes.
    Elements that hold nothing are closed at once: inside SVG the others would nest.
    """
    words = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        plain = key.rstrip("_").replace("_", "-")
        words.append(plain if value is True else f'{plain}="{_number(value)}"')
    if name in _VOID:
        return Html(f"<{' '.join(words)} />")
    return Html(f"<{' '.join(words)}>{joined(*children)}</{name}>")


def joined(*children: Content) -> Html:
    """Several pieces after one another."""
    return Html("".join(c if isinstance(c, Html) else _escaped(c) for c in children))


def _escaped(text: str) -> str:
    return html.escape(printable_lines(text))


def figure(picture: Content, caption: Content, **attributes: str | None) -> Html:
    """A picture with the words below it."""
    return tag("figure", picture, tag("figcaption", caption), **attributes)


def image(uri: str, alt: str, size: tuple[int, int], **attributes: str | None) -> Html:
    """A picture that the browser decodes when it comes into sight.

    Args:
        size: width, height in pixels, so that nothing jumps.
    """
    width, height = size
    return tag(
        "img",
        src=uri,
        alt=alt,
        width=width,
        height=height,
        loading="lazy",
        decoding="async",
        **attributes,
    )


def coded(text: str) -> Html:
    """Words with `commands` in them: what stands between backticks is code."""
    parts = re.split(r"`([^`]*)`", text)
    return joined(*(tag("code", part) if i % 2 else part for i, part in enumerate(parts)))


def table(head: tuple[str, ...], rows: list[tuple[Content, ...]], **attributes: str | None) -> Html:
    """A table; the first cell of a row is its heading.

    Wide ones scroll by themselves. On a narrow screen each row is a block whose cells have the
    head's words before them; the roles keep it a table for screen readers.
    """
    cells = [tag("th", cell, scope="col", role="columnheader") for cell in head]
    top = tag("tr", *cells, role="row") if any(head) else Html("")
    body = [
        tag(
            "tr",
            tag("th", row[0], scope="row", role="rowheader"),
            *(
                tag("td", cell, role="cell", data_label=label or None)
                for cell, label in zip(row[1:], (*head[1:], *[""] * len(row)), strict=False)
            ),
            role="row",
        )
        for row in rows
    ]
    parts = tag("thead", top, role="rowgroup"), tag("tbody", *body, role="rowgroup")
    words = f"Table: {next(filter(None, head), 'figures')}"
    whole = tag("table", *parts, role="table", **attributes)
    return tag("div", whole, class_="scroll", tabindex=0, role="group", aria_label=words)


def _number(value: str | int | float) -> str:
    if isinstance(value, float):
        return f"{value:.2f}".rstrip("0").rstrip(".")
    return html.escape(str(value))
