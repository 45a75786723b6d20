"""The page of a batch: a table that sorts, and a contact sheet that leads to each report."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from refdgs_pipe import __version__
from refdgs_pipe.formatting import counted, duration
from refdgs_pipe.pipeline.atomic import disk_errors, write_text
from refdgs_pipe.reporting.html import Content, Html, joined, tag
from refdgs_pipe.reporting.page import document

_POLICY = ("img-src data: blob:", "img-src 'self' file: data: blob:")  # pictures lie beside it
_MARKS = {"good": "good", "fair": "fair", "poor": "poor"}
_HEAD = ("capture", "state", "verdict", "score", "time", "attempts", "warnings", "words")


@dataclass(frozen=True)
class Entry:
    """One capture.

    Args:
        score: of the verdict; seconds: of all its jobs.
        report, picture: relative to the page; None where there is none.
    """

    name: str
    state: str
    verdict: str | None
    score: float | None
    seconds: float
    attempts: int
    warnings: int
    words: str
    report: str | None
    picture: str | None


def write_catalogue(path: Path, title: str, entries: Sequence[Entry]) -> None:
    """Write the page.

    Raises:
        WriteError: it cannot be written.
    """
    with disk_errors(path.parent):
        write_text(path, catalogue(title, entries))


def catalogue(title: str, entries: Sequence[Entry]) -> Html:
    """The whole page. Nothing that it says of a capture can become markup."""
    states = [entry.state for entry in entries]
    tiles = [
        tag("div", tag("dt", state), tag("dd", str(states.count(state))), class_="tile")
        for state in dict.fromkeys(states)
    ]
    spent = duration(sum(entry.seconds for entry in entries))
    tiles.append(tag("div", tag("dt", "time of all jobs"), tag("dd", spent), class_="tile"))
    pictured = [entry for entry in entries if entry.picture]
    script = files("refdgs_pipe.reporting").joinpath("assets", "catalogue.js").read_text("utf-8")
    body = joined(
        tag("header", tag("h1", title), tag("dl", *tiles, class_="tiles")),
        tag(
            "main",
            tag("section", tag("h2", "Captures"), _table(entries), id="captures"),
            tag("section", tag("h2", "Contact sheet"), _sheet(pictured), id="sheet"),
        ),
        tag("footer", f"refdgs-pipe {__version__}, {counted(len(entries), 'capture')}"),
        tag("script", Html(script)),
    )
    return Html(document(f"{title} - refdgs-pipe batch", body).replace(*_POLICY, 1))


def _table(entries: Sequence[Entry]) -> Html:
    """The table; each cell has what it is sorted by."""
    head = [
        tag("th", tag("button", word, type="button"), scope="col", aria_sort="none")
        for word in _HEAD
    ]
    rows = [tag("tr", *_cells(entry), class_=entry.state.replace(" ", "-")) for entry in entries]
    whole = tag(
        "table", tag("thead", tag("tr", *head)), tag("tbody", *rows), class_="sortable", id="table"
    )
    hint = tag("p", "Click a column's head to sort by it, again to turn it round.", class_="hint")
    words = "Table of captures"
    box = tag("div", whole, class_="scroll", tabindex=0, role="group", aria_label=words)
    return joined(hint, box)


def _cells(entry: Entry) -> list[Html]:
    score = "" if entry.score is None else f"{entry.score:.2f}"
    order = "" if entry.score is None else repr(float(entry.score))
    mark = _MARKS.get(entry.verdict or "", "")
    plain: list[tuple[Content, str]] = [
        (entry.state, entry.state),
        (tag("span", entry.verdict or "", class_=f"mark {mark}"), entry.verdict or ""),
        (score, order),
        (duration(entry.seconds) if entry.seconds else "", repr(float(entry.seconds))),
        (str(entry.attempts), str(entry.attempts)),
        (str(entry.warnings), str(entry.warnings)),
        (entry.words, entry.words),
    ]
    first = tag("th", _linked(entry, entry.name), scope="row", data_order=entry.name)
    return [first, *(tag("td", shown, data_order=by) for shown, by in plain)]


def _sheet(entries: Sequence[Entry]) -> Html:
    if not entries:
        return tag("p", "No capture has an asset yet.", class_="none")
    figures = []
    for entry in entries:
        picture = tag(
            "img",
            src=quote(entry.picture or ""),
            alt=f"{entry.name}, its textured mesh",
            loading="lazy",
            decoding="async",
        )
        words = tag("figcaption", entry.name, tag("small", entry.verdict or entry.state))
        figures.append(tag("figure", _linked(entry, picture), words, class_="photo"))
    return tag("div", *figures, class_="contact")


def _linked(entry: Entry, content: Content) -> Content:
    """What leads to the capture's report, where there is one."""
    return tag("a", content, href=quote(entry.report)) if entry.report else content
