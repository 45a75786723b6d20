"""The report: one page that needs no other file, no network and no server."""

import hashlib
import json
from dataclasses import dataclass
from importlib import import_module
from importlib.resources import files
from pathlib import Path

from refdgs_pipe import __version__
from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.placement import Placement
from refdgs_pipe.artifacts.scores import Scores
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.atomic import disk_errors, write_text
from refdgs_pipe.pipeline.stage import Artifact
from refdgs_pipe.reporting import overview
from refdgs_pipe.reporting.facts import Drawing, Facts, readable
from refdgs_pipe.reporting.html import Html, joined, tag

NAME = "report.html"
_LAYOUT = 7  # raised when the page changes, so that older ones are made again
_POLICY = (  # the browser itself keeps the page from fetching anything
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; connect-src data: blob:; "
    "worker-src blob:; base-uri 'none'; form-action 'none'"
)


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Args:
        drawn_by: module and function of this package; loaded only when there is something to draw.
        needs: the kinds of artifact that it shows.
        nav: whether the row of links at the top has it.
    """

    name: str
    title: str
    drawn_by: tuple[str, str]
    needs: tuple[type[Artifact], ...] = ()
    nav: bool = False

    def draw(self, facts: Facts, drawing: Drawing) -> Html:
        """What it shows; called only when all that it needs is there."""
        module = import_module(f"refdgs_pipe.reporting.{self.drawn_by[0]}")
        drawn: Html = getattr(module, self.drawn_by[1])(facts, drawing)
        return drawn


SECTIONS = (
    Section("model", "The asset", ("asset", "viewer"), (Asset,), nav=True),
    Section("delivery", "Files", ("delivery", "delivery"), (Asset,), nav=True),
    Section("photos", "Photos", ("photos", "contact_sheet"), (Views,), nav=True),
    Section("cameras", "Cameras", ("photos", "cameras"), (SparseModel,), nav=True),
    Section("coverage", "Coverage", ("coverage", "coverage"), (SparseModel, TexturedMesh), True),
    Section("masks", "Masks", ("masks", "masks"), (Masks, Views, SparseModel)),
    Section(
        "views",
        "Photo and result",
        ("views", "comparisons"),
        (Views, SparseModel, SurfelField),
        nav=True,
    ),
    Section("mesh", "Mesh", ("asset", "turntable"), (SparseModel, TexturedMesh), nav=True),
    Section("light", "Light around the object", ("views", "surroundings"), (Asset,)),
    Section("scores", "Figures", ("records", "scores"), (Scores,), nav=True),
    Section("placement", "Placement of the photos", ("placement", "placement"), (Views, Placement)),
    Section("maps", "What was learned", ("views", "maps"), (SparseModel, SurfelField)),
    Section("atlas", "Textures", ("asset", "atlas"), (TexturedMesh,)),
    Section("training", "Training", ("views", "training"), (SurfelField,)),
    Section("files", "Checks of the files", ("records", "files"), (Asset,)),
    Section("stages", "Stages", ("records", "stages")),
    Section("settings", "Settings", ("records", "settings"), nav=True),
)


def write_report(path: Path, facts: Facts, drawing: Drawing | None = None) -> list[str]:
    """Write the report, unless the one that is there says the same.

    Returns:
        What could not be shown, and why; the rest of the page is there all the same.

    Raises:
        WriteError: the page cannot be written.
    """
    key = _key(facts)
    if _key_of(path) == key:
        return []
    problems: list[str] = []
    text = page(facts, drawing or Drawing(), problems, key=key)
    with disk_errors(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
    return problems


def page(facts: Facts, drawing: Drawing, problems: list[str], *, key: str = "") -> Html:
    """The whole page. What fails is noted in `problems` and on the page."""
    bodies = [_section(part, facts, drawing, problems) for part in SECTIONS]
    links = [tag("a", part.title, href=f"#{part.name}") for part in SECTIONS if part.nav]
    body = joined(
        tag("a", "Skip to the asset", href="#model", class_="skip"),
        tag("header", tag("h1", facts.title), overview.head(facts), overview.tiles(facts)),
        tag("nav", *links, aria_label="Parts of this page"),
        tag("main", *bodies),
        tag("footer", f"refdgs-pipe {__version__}, recipe {facts.recipe}"),
    )
    return document(f"{facts.title} - refdgs-pipe report", body, key=key)


def document(title: str, body: Html, *, key: str = "") -> Html:
    """A page of its own around this body, with our style and script; it fetches nothing.

    Args:
        key: tells whether a page that is there says the same.
    """
    assets = files("refdgs_pipe.reporting").joinpath("assets")
    top = joined(
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("meta", name="generator", content=f"refdgs-pipe {__version__}"),
        tag("meta", name="refdgs-key", content=key),
        tag("title", title),
        tag("style", Html(assets.joinpath("report.css").read_text("utf-8"))),
    )
    script = tag("script", Html(assets.joinpath("report.js").read_text("utf-8")))
    whole = tag("body", body, script)
    return Html(f'<!DOCTYPE html>\n<html lang="en"><head>{top}</head>\n{whole}</html>\n')


def _section(part: Section, facts: Facts, drawing: Drawing, problems: list[str]) -> Html:
    needed = [facts.result(kind) for kind in part.needs]
    absent = [
        facts.maker(kind) for kind, found in zip(part.needs, needed, strict=True) if found is None
    ]
    note = Html("")
    if absent:
        stages = ", ".join(absent)
        body = tag("p", f"Nothing yet: to be made by {stages}.", class_="none")
    else:
        old = [found.name for found in needed if found and not found.is_current]
        if old and any(result.is_current for result in facts.results):
            words = f"From an older run: {', '.join(old)} would now give another result."
            note = tag("p", words, class_="stale")
        try:
            body = part.draw(facts, drawing)
        except Exception as error:  # the page is about the results, and must not fail for one
            words = facts.plain(readable(error))
            problems.append(f"{part.title}: {words}")
            body = tag("p", f"This could not be shown: {words}", class_="none")
    return tag("section", tag("h2", part.title), note, body, id=part.name)


def _key(facts: Facts) -> str:
    """A hash of all that the page says."""
    results = [
        (
            r.name,
            r.step.state,
            r.step.reason,
            r.manifest and (r.manifest.origin.key, r.manifest.made_utc),
        )
        for r in facts.results
    ]
    notes = (sorted(facts.notes.made), facts.notes.failure and vars(facts.notes.failure))
    about = (facts.title, facts.recipe, facts.draft, facts.changed, facts.settings)
    text = json.dumps([_LAYOUT, __version__, results, notes, len(facts.notes.curve), about])
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _key_of(path: Path) -> str | None:
    """The key of the page that is there."""
    try:
        with path.open("rb") as file:
            text = file.read(4096).decode("utf-8", "replace")
    except OSError:
        return None
    return text.partition('name="refdgs-key" content="')[2].partition('"')[0] or None
