"""Markup that cannot be broken by what it holds: every plain string is escaped when it enters."""

import html
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


def table(head: tuple[str, ...], rows: list[tuple[Content, ...]], **attributes: str | None) -> Html:
    """A table; the first cell of a row is its heading. Wide ones scroll by themselves."""
    top = tag("tr", *(tag("th", cell, scope="col") for cell in head)) if any(head) else Html("")
    body = [
        tag("tr", tag("th", row[0], scope="row"), *(tag("td", cell) for cell in row[1:]))
        for row in rows
    ]
    whole = tag("table", tag("thead", top), tag("tbody", *body), **attributes)
    return tag("div", whole, class_="scroll")


def _number(value: str | int | float) -> str:
    if isinstance(value, float):
        return f"{value:.2f}".rstrip("0").rstrip(".")
    return html.escape(str(value))
