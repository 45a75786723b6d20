"""The report is one safe page, says what is there, and never stumbles over what is not."""

import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import finished
import pytest

from refdgs_pipe.artifacts.asset import Asset, Delivery
from refdgs_pipe.pipeline.store import Store
from refdgs_pipe.reporting import asset, html, overview
from refdgs_pipe.reporting import facts as facts_module
from refdgs_pipe.reporting.delivery import delivery
from refdgs_pipe.reporting.dimensions import Dimensions, dimensions, is_size_known
from refdgs_pipe.reporting.facts import TRAINED, Drawing, Facts, collect
from refdgs_pipe.reporting.overview import Reason, judge
from refdgs_pipe.reporting.page import SECTIONS, page, write_report

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)
ABOUT: dict[str, Any] = {
    "recipe": "glossy",
    "changed": ("bake.size=64",),
    "settings": {"bake": {"size": 64, "note": "<i>"}},
}


def facts_of(root: Path, **options: Any) -> Facts:
    store = Store(root)
    found = finished.steps(store, **options)
    return collect(store, found, about=ABOUT, private=[root.parent])


@pytest.fixture(scope="module", autouse=True)
def small_frames() -> Iterator[None]:
    """The turntable takes most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asset, "_FRAME", 40)
        patch.setattr(asset, "_CLOSE_UP", 40)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Facts:
    root = tmp_path_factory.mktemp("work") / "ball.refdgs"
    finished.log(
        Store(root),
        *(
            {
                "event": "sampled",
                "stage": "train",
                "step": i,
                "figures": {"loss": round(1 / i, 3), "psnr": i},
            }
            for i in (10, 20, 30)
        ),
        {"event": "finished", "stage": "train", "seconds": finished.SECONDS},
        {
            "event": "sampled",
            "stage": "refine",
            "step": 40,
            "figures": {"loss": 0.02, "psnr": 41},
        },
        {"event": "finished", "stage": "refine", "seconds": finished.SECONDS},
    )
    return facts_of(root)


@pytest.fixture(scope="module")
def text(whole: Facts) -> str:
    problems: list[str] = []
    made = page(whole, Drawing(), problems)
    assert problems == []
    return made


class Reader(HTMLParser):
    """Collects elements; fails where they are not nested as they should be."""

    VOID = ("meta", "img", "input", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def body_of(text: str, name: str) -> str:
    """The markup of a section."""
    return text.partition(f'<section id="{name}">')[2].partition("</section>")[0]


def test_a_finished_workspace_fills_every_section(text: str) -> None:
    ids = [attributes.get("id") for tag, attributes in Reader(text).found if tag == "section"]
    assert ids == [section.name for section in SECTIONS]
    for section in SECTIONS:
        assert 'class="none"' not in body_of(text, section.name), section.name
    assert "Good: nothing that was measured on the object speaks against it." in text
    assert len(re.findall(r'<figure class="photo', text)) == 6
    assert body_of(text, "cameras").count('class="camera ') == 2 * 5
    assert body_of(text, "training").count("<polyline") == 2
    assert body_of(text, "views").count("<img") == 4  # one view was held out: photo, render, relit
    assert body_of(text, "maps").count("<img") == 4
    assert body_of(text, "atlas").count("<img") == 6
    assert body_of(text, "coverage").count("<img") == 5
    assert "20.00 dB" in body_of(text, "scores")
    assert body_of(text, "files").count('<b class="ok">ok</b>') > 8


def test_the_page_says_how_the_light_moved(text: str) -> None:
    assert "The light stood still with the object (the ground does not darken)." in text
    assert "set lighting.kind" in text


def test_lost_and_blurred_photos_come_first_with_their_reason(text: str) -> None:
    cards = re.findall(r'<figure class="photo([^"]*)".*?</figure>', body_of(text, "photos"))
    assert sorted(cards[:2]) == [" blurred", " lost"]
    assert "only 3 &lt;matches&gt;" in text
    assert "1 lost" in text and "1 blurred" in text and "1 kept for testing" in text


def test_names_of_files_cannot_break_the_page(text: str) -> None:
    assert finished.EVIL not in text
    assert "&lt;script&gt;alert(&quot;1&quot;)&lt;/script&gt;.jpg" in text
    assert "<b>bad.jpg" not in text and "&lt;b&gt;bad.jpg" in text
    assert "<i>" not in body_of(text, "settings")
    scripts = [attributes for tag, attributes in Reader(text).found if tag == "script"]
    assert [script.get("id") for script in scripts] == ["glb", "light", "seen", "viewer", None]


def test_the_page_needs_nothing_but_itself(text: str) -> None:
    found = Reader(text).found
    addresses = [
        value
        for tag, attributes in found
        for name, value in attributes.items()
        if name in ("src", "href", "srcset", "data", "action", "poster")
    ]
    assert addresses
    assert all(str(a).startswith(("data:image/", "#")) for a in addresses)
    css = "".join(re.findall(r"<style>(.*?)</style>", text, re.DOTALL))
    assert "url(" not in css and "@import" not in css
    policy = next(a["content"] for t, a in found if a.get("http-equiv"))
    assert policy is not None
    assert "default-src 'none'" in policy and "http" not in policy and "*" not in policy
    assert not {tag for tag, _ in found} & {"link", "iframe", "object", "embed", "base"}


def test_the_same_workspace_gives_the_same_page(text: str, whole: Facts) -> None:
    assert page(whole, Drawing(), []) == text


def test_folders_of_this_machine_are_left_out(tmp_path: Path) -> None:
    warning = f"look at {tmp_path}/ball.refdgs/sfm"
    found = facts_of(tmp_path / "ball.refdgs", until="gate", warning=warning)
    made = page(found, Drawing(), [])
    assert str(tmp_path) not in made and "look at ball.refdgs/sfm" in made


@pytest.mark.parametrize("until", ["ingest", "sfm", "train", "clean", "bake", "export"])
def test_what_has_not_run_is_said_and_the_rest_is_shown(until: str, tmp_path: Path) -> None:
    problems: list[str] = []
    made = page(facts_of(tmp_path / "ball.refdgs", until=until), Drawing(), problems)
    Reader(made)
    assert problems == []
    assert 'class="verdict unfinished"' in made
    assert "to be made by evaluate" in body_of(made, "scores")
    assert body_of(made, "photos").count("<img") == 6


def test_an_empty_workspace_has_a_page_too(tmp_path: Path) -> None:
    found = [
        type(step)(step.stage, "missing", "never run")
        for step in finished.steps(Store(tmp_path / "other"), until="ingest")
    ]
    facts = collect(Store(tmp_path / "empty"), found, about=ABOUT)
    made = page(facts, Drawing(), [])
    assert "Nothing yet" in made and judge(facts).word == "unfinished"


def test_a_damaged_result_costs_only_its_own_sections(tmp_path: Path) -> None:
    found = facts_of(tmp_path / "ball.refdgs")
    (found.result(finished.SurfelField).folder / "field.safetensors").write_bytes(b"no")  # type: ignore
    (found.result(finished.Asset).folder / "asset.glb").write_bytes(b"glTF")  # type: ignore
    problems: list[str] = []
    made = page(found, Drawing(), problems)
    Reader(made)
    assert {problem.partition(":")[0] for problem in problems} == {
        "Photo and result",
        "What was learned",
    }
    assert "changed since it was written" in body_of(made, "files")
    assert body_of(made, "mesh").count("<img") > 10


def test_the_verdict_is_the_worst_of_what_was_measured_and_says_what_to_do(tmp_path: Path) -> None:
    bad = replace(finished.FINE, psnr=24.0, training_psnr=24.5, part_share=0.3, parts=7)
    found = facts_of(tmp_path / "a", warning="three photos lost", evidence=bad)
    opinion = judge(found)
    assert (opinion.word, opinion.line[:5]) == ("poor", "Poor:")
    assert [reason.word for reason in opinion.reasons[:3]] == ["poor", "fair", "good"]
    assert opinion.reasons[-1].words == "three photos lost"
    made = overview.head(found)
    assert 'class="verdict poor"' in made
    assert "Much of the surface is loose pieces." in made
    assert "Raise <code>clean.floater</code>" in made
    assert "7, 30% of the surface" in made.partition("<details>")[2]
    fair = replace(finished.FINE, psnr=24.0, training_psnr=24.5)
    draft = replace(facts_of(tmp_path / "b", evidence=fair), draft=True)
    assert judge(draft).line.startswith("Fair: a first look.")
    assert judge(facts_of(tmp_path / "c", evidence=None)).word == "unjudged"


def test_the_top_names_the_photos_to_take_again(text: str) -> None:
    top = text.partition('id="verdict"')[2].partition("<nav")[0]
    lost, blurred = (finished.CAMERAS[i].name for i in (5, 1))
    assert f"Take photos between these and the others: {lost}.jpg" in top
    assert f"Take these again, they are blurred: {blurred}.jpg" in top


def test_a_first_look_says_how_to_get_the_full_quality(tmp_path: Path) -> None:
    draft = replace(facts_of(tmp_path / "b"), draft=True)
    assert "<code>refdgs-pipe run PHOTOS --recipe glossy</code>" in overview.head(draft)


def test_equal_warnings_are_one_line(whole: Facts) -> None:
    texts = [f"IMG_{i}.jpg: the clock is wrong" for i in range(20)]
    manifest = whole.results[0].manifest
    assert manifest is not None
    loud = replace(whole.results[0], manifest=replace(manifest, warnings=tuple(texts)))
    facts = replace(whole, results=(loud, *whole.results[1:]))
    assert [r.words for r in judge(facts).reasons if r.about == "ingest"] == [
        "IMG_0.jpg and 19 more: the clock is wrong"
    ]


def test_files_are_named_by_what_they_are_for(text: str) -> None:
    rows = re.findall(r"<tr.*?</tr>", body_of(text, "delivery"), re.DOTALL)
    game, ar = (next(row for row in rows if f">{use}</th>" in row) for use in ("Game", "AR"))
    assert "asset.glb" in game and "asset.usdz" in ar


def test_files_that_were_made_for_a_use_are_named_for_it(tmp_path: Path) -> None:
    plain = facts_of(tmp_path)
    folder = plain.folder(Asset)
    for name in ("web/asset.glb", "print/asset.3mf"):
        (folder / "targets" / name).parent.mkdir(parents=True)
        (folder / "targets" / name).write_bytes(b"x" * 3000)
    made = (
        Delivery("web", ("targets/web/asset.glb",), "9000 triangles", {}, ("A note",)),
        Delivery("print", ("targets/print/asset.3mf",), "closed", {}),
    )
    Asset.of(folder, faces=1, texture_size=64, targets=made).save(folder)
    said = str(delivery(plain, Drawing()))
    rows = re.findall(r"<tr.*?</tr>", said, re.DOTALL)
    (web,) = [row for row in rows if ">Web</th>" in row]
    assert "targets/web/asset.glb" in web and "9000 triangles. A note." in web
    assert any("3D printing" in row and "targets/print/asset.3mf" in row for row in rows)


def test_the_size_is_told_with_its_three_sides(text: str) -> None:
    assert re.search(r"[\d.]+ x [\d.]+ x [\d.]+ c?m", body_of(text, "model"))
    assert "The real size is unknown" in body_of(text, "model")


def test_a_size_that_is_not_known_is_not_told_as_one() -> None:
    assert not is_size_known("unknown: exported 1.21 m long. Give --size METRES, or use a mat")
    assert is_size_known("0.23 m, given")


@pytest.mark.parametrize(
    ("sides", "words"),
    [((0.23, 0.142, 0.151), "23 x 14.2 x 15.1 cm"), ((1.5, 1, 0.5), "1.5 x 1 x 0.5 m")],
)
def test_dimensions_have_the_unit_that_suits_them(
    sides: tuple[float, float, float], words: str
) -> None:
    assert Dimensions(*sides).words == words


def test_a_file_that_is_no_glb_has_no_dimensions(tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(b"glTF")
    assert dimensions(tmp_path / "a.glb") is None
    assert dimensions(tmp_path / "b.glb") is None


def test_every_figure_and_setting_has_its_meaning(text: str) -> None:
    cell = r'<td role="cell" data-label="what it means">(.*?)</td>'
    scores, settings = (re.findall(cell, body_of(text, name)) for name in ("scores", "settings"))
    assert scores and all(scores)
    assert settings[0] == "texels along a side; a power of two"


def test_words_of_the_trade_stay_in_the_figures(text: str) -> None:
    figures = text.index('<section id="scores"')
    hidden = r"<script.*?</script>|<style.*?</style>|<details>.*?</details>|<[^>]*>"
    plain = re.sub(hidden, " ", text[:figures], flags=re.DOTALL)
    assert [w for w in ("held out", "n / 2", "surfel", "texel", "chart") if w in plain] == []


def test_what_did_not_come_to_its_end_has_a_state_instead_of_a_verdict(tmp_path: Path) -> None:
    store = Store(tmp_path / "b")
    finished.log(
        store,
        {"event": "started", "stage": "train"},
        {"event": "failed", "kind": "TrainingError", "message": "training diverged"},
    )
    failed = judge(facts_of(store.root, until="sfm"))
    assert (failed.word, failed.reasons) == ("failed", (Reason("train", "training diverged"),))
    finished.log(store, {"event": "failed", "kind": "Cancelled", "message": "stopped"}, name="2")
    assert judge(facts_of(store.root, until="sfm")).word == "unfinished"


def test_a_resumed_training_gives_one_curve(tmp_path: Path) -> None:
    def told(step: int) -> dict[str, Any]:
        return {
            "event": "sampled",
            "stage": "train",
            "step": step,
            "figures": {"loss": 0.1, "psnr": float(step)},
        }

    done = {"event": "finished", "stage": "train", "seconds": finished.SECONDS}
    store = Store(tmp_path / "ball.refdgs")
    finished.log(store, told(10), told(999), done | {"seconds": 1.0}, name="1")  # an older training
    finished.log(store, *map(told, (10, 100, 200, 300)), name="2")  # killed after a checkpoint
    finished.log(store, *map(told, (210, 310)), done, name="3")
    curve = facts_of(store.root, until="train").notes.curve
    assert [step for step, _, _ in curve] == [10, 100, 200, 210, 310]


def test_both_parts_of_a_training_give_one_curve(tmp_path: Path) -> None:
    def told(stage: str, *steps: int) -> list[dict[str, Any]]:
        figures = {"loss": 0.1, "psnr": 20.0}
        return [{"event": "sampled", "stage": stage, "step": s, "figures": figures} for s in steps]

    done = {stage: {"event": "finished", "stage": stage, "seconds": 12.5} for stage in TRAINED}
    assert finished.SECONDS == 12.5
    store = Store(tmp_path / "ball.refdgs")
    other = done["refine"] | {"seconds": 1.0}
    first = [*told("train", 10, 200), done["train"], *told("refine", 210, 300), other]
    finished.log(store, *first, name="1")
    finished.log(store, *told("refine", 210, 260), name="2")  # with other settings, and killed
    finished.log(store, *told("refine", 290, 300), done["refine"], name="3")
    curve = facts_of(store.root, until="refine").notes.curve
    assert [step for step, _, _ in curve] == [10, 200, 210, 260, 290, 300]


def test_a_page_with_nothing_new_to_say_is_left_alone(whole: Facts, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    assert write_report(path, whole) == []
    path.write_text(path.read_text() + "<!-- mine -->")
    write_report(path, whole)
    assert path.read_text().endswith("<!-- mine -->")
    path.write_text("something else")
    write_report(path, whole)
    assert path.read_text().startswith("<!DOCTYPE html>")


def test_a_large_asset_is_shown_with_smaller_textures(
    whole: Facts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("refdgs_pipe.reporting.asset._MOST_BYTES", 70_000)
    problems: list[str] = []
    made = page(whole, Drawing(), problems)
    assert problems == [] and "its textures are reduced" in made


def test_markup_is_escaped_unless_it_is_markup() -> None:
    assert html.tag("p", "<&", html.tag("b", '"')) == "<p>&lt;&amp;<b>&quot;</b></p>"
    assert html.tag("a", href='"><x') == '<a href="&quot;&gt;&lt;x"></a>'
    assert html.tag("img", alt=None, hidden=True) == "<img hidden />"
    assert facts_module.readable(ValueError("a\nb")) == "ValueError: a"


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_a_browser_shows_the_page_and_the_asset(text: str, tmp_path: Path) -> None:
    click = """<script>
    document.getElementById('start-3d').click();
    new MutationObserver((_, watch) => {
      watch.disconnect();
      document.querySelector('input[value=rough]').click();
      document.getElementById('wire-3d').click();
    }).observe(document.getElementById('choices-3d'), { attributes: true });
    </script></body>"""
    (tmp_path / "report.html").write_text(text.replace("</body>", click))
    run = subprocess.run(
        [
            str(CHROMIUM),
            *("--headless=new", "--no-sandbox", "--enable-logging=stderr", "--v=0"),
            *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
            *("--virtual-time-budget=20000", "--dump-dom", f"--user-data-dir={tmp_path / 'home'}"),
            (tmp_path / "report.html").as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=240,
        check=True,
    )
    assert 'data-state="loaded"' in run.stdout
    assert "White is rough, black is a mirror." in run.stdout.partition('id="told-3d"')[2][:200]
    said = [line for line in run.stderr.splitlines() if "CONSOLE" in line]
    usual = ("rAF timed out", "RGBELoader")  # the viewer's own remarks
    assert [line for line in said if not any(word in line for word in usual)] == []
