"""The page of `check`: the verdict first, then what it rests on."""

from collections.abc import Callable
from pathlib import Path

from refdgs_pipe import __version__
from refdgs_pipe.checking.findings import Finding
from refdgs_pipe.checking.record import Checked
from refdgs_pipe.formatting import about_room, counted, roughly
from refdgs_pipe.pipeline.atomic import disk_errors, write_text
from refdgs_pipe.reporting import placement, plots
from refdgs_pipe.reporting.facts import readable
from refdgs_pipe.reporting.html import Content, Html, figure, joined, table, tag
from refdgs_pipe.reporting.page import document
from refdgs_pipe.reporting.photos import camera_plans, photo_faults, sheet

_CLASSES = {"yes": "good", "but": "degraded", "unclear": "degraded", "no": "failed"}
_STATES = {
    "ok": ("ok", "ok"),
    "note": ("note", "hint"),
    "but": ("but", "but"),
    "bad": ("no", "bad"),
}


def write_check(path: Path, title: str, checked: Checked) -> None:
    """Write the page of a check.

    Raises:
        WriteError: it cannot be written.
    """
    text = check_page(title, checked)
    with disk_errors(path.parent):
        write_text(path, text)


def check_page(title: str, checked: Checked) -> Html:
    """The whole page; what cannot be shown is said in its place."""
    parts: tuple[tuple[str, str, Callable[[Checked], Html]], ...] = (
        ("findings", "What was found", _findings),
        ("placement", "Placement", _placement),
        ("coverage", "Round the object", _coverage),
        ("photos", "Photos", _photos),
        ("cost", "Time and room", _cost),
    )
    drawn = [(name, head, _drawn(draw, checked)) for name, head, draw in parts]
    shown = [entry for entry in drawn if entry[2]]
    body = joined(
        tag("header", tag("h1", title), _verdict(checked)),
        tag("nav", *(tag("a", head, href=f"#{name}") for name, head, _ in shown)),
        tag("main", *(tag("section", tag("h2", h), b, id=name) for name, h, b in shown)),
        tag("footer", f"refdgs-pipe {__version__} check, in {checked.seconds:.0f} s"),
    )
    return document(f"{title} - refdgs-pipe check", body)


def _drawn(draw: Callable[[Checked], Html], checked: Checked) -> Html:
    try:
        return draw(checked)
    except Exception as error:  # the page is about the photos, and must not fail for a picture
        return tag("p", f"This could not be shown: {readable(error)}", class_="none")


def _verdict(checked: Checked) -> Html:
    verdict = checked.verdict
    advice = [tag("li", text) for text in verdict.to_do]
    return tag(
        "div",
        tag("p", verdict.line, class_="line"),
        tag("ul", *advice) if advice else Html(""),
        id="verdict",
        class_=f"verdict {_CLASSES[verdict.word]}",
    )


def _findings(checked: Checked) -> Html:
    rows = [_row(finding) for finding in checked.findings]
    return table(("about", "state", "found"), rows, class_="findings")


def _row(finding: Finding) -> tuple[Content, ...]:
    word, kind = _STATES[finding.state]
    told: Content = finding.text
    if finding.advice:
        told = joined(finding.text, tag("small", finding.advice))
    return finding.name, tag("b", word, class_=kind), told


def _placement(checked: Checked) -> Html:
    look = checked.look
    if look.views is None:
        return Html("")
    if look.is_known:
        said = tag("p", "The places came with the photos; nothing had to be found.")
        return joined(said, placement.overlay(look.views, look.model))
    if look.judgement is None or look.placement is None:
        return Html("")
    return joined(
        placement.verdict_line(look.judgement, len(look.tried)),
        placement.attempts_table(look.placement.attempts),
        placement.notes_list(look.placement.notes),
        placement.checks_table(look.judgement.checks),
        placement.overlay(look.views, look.model),
    )


def _coverage(checked: Checked) -> Html:
    found, look = checked.around, checked.look
    if found is None or look.model is None or look.views is None:
        return Html("")
    said = {view.name: view.source or view.name for view in look.views.items}
    dots = [(said.get(d.name, d.name), d.azimuth, d.height) for d in found.directions]
    plot = plots.directions(dots, found.widest, label="directions that photos were taken from")
    words = (
        "Each dot is a photo: to the right the direction round the object, upwards the height "
        f"above its middle. Shaded: the widest stretch without one, {found.gap_deg:.0f} degrees."
    )
    gaps = look.judgement.gaps if look.judgement is not None else ()
    return joined(
        tag("p", words),
        tag("div", figure(plot, "round the object"), class_="wide"),
        placement.notes_list(gaps),
        camera_plans(look.model),
    )


def _photos(checked: Checked) -> Html:
    look = checked.look
    if look.views is None:
        return Html("")
    faults = photo_faults(look.views, look.judgement.lost if look.judgement else {})
    return sheet(look.views, faults)


def _cost(checked: Checked) -> Html:
    if not checked.costs:
        return Html("")
    rows: list[tuple[Content, ...]] = [
        (cost.recipe, roughly(cost.seconds), about_room(cost.bytes), cost.about)
        for cost in checked.costs
    ]
    cores = counted(checked.cores, "core")
    words = f"A rough estimate for {cores} of this machine, without a GPU and other work beside."
    return joined(tag("p", words), table(("recipe", "time", "room on disk", "for"), rows))
