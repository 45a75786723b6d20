"""The laws of the engine: what is made again, what is not, and what is said about it."""

import threading
from dataclasses import replace
from pathlib import Path

import pytest
from fake_stages import (
    STAGES,
    Letters,
    Page,
    PrintParams,
    Shout,
    ShoutParams,
    Words,
    read,
)
from letter_scene import PUBLISH, SETTINGS, Scene, made

from refdgs_pipe.errors import Cancelled, InputError, MeshError
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.events import Damaged, Event, Finished, Reused, Started, Warned
from refdgs_pipe.pipeline.plan import Pipeline
from refdgs_pipe.pipeline.runner import Request, run
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.pipeline.store import MANIFEST, Store


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def test_everything_is_made_once_and_then_reused(scene: Scene) -> None:
    assert set(scene.reasons().values()) == {
        "never run",
        "waits for read",
        "waits for shout and read",
    }
    assert made(scene.run()) == ["read", "shout", "export"]
    log = scene.run()
    assert made(log) == []
    assert [event.stage for event in log if isinstance(event, Reused)] == [
        "read",
        "shout",
        "export",
    ]
    assert scene.page == "HELLO THERE OLD WORLD! (hello there old world) 20.0"


def test_a_changed_setting_remakes_only_what_follows_and_says_why(scene: Scene) -> None:
    scene.run()
    scene.settings["shout"] = ShoutParams(marks=3)
    assert scene.reasons() == {
        "read": "up to date",
        "shout": "marks 1 -> 3",
        "export": "waits for shout",
    }
    assert made(scene.run()) == ["shout", "export"]


def test_setting_back_is_instant(scene: Scene) -> None:
    scene.run()
    scene.settings["shout"] = ShoutParams(marks=3)
    scene.run()
    scene.settings = dict(SETTINGS)
    assert made(scene.run()) == []


def test_an_equal_output_stops_the_ripple(scene: Scene) -> None:
    scene.run()
    (scene.letters / "0.txt").write_text("hello there")
    assert scene.reasons()["read"] == "new letters (1 of 3 files changed)"
    assert made(scene.run()) == ["read"]


def test_added_and_removed_photos_are_counted(scene: Scene) -> None:
    scene.run()
    (scene.letters / "2.txt").unlink()
    (scene.letters / "3.txt").write_text("x")
    (scene.letters / "4.txt").write_text("y")
    assert scene.reasons()["read"] == "new letters (2 added, 1 removed)"


def test_a_new_input_is_named_with_the_stage_that_changed_it(scene: Scene) -> None:
    scene.run()
    (scene.letters / "0.txt").write_text("other")
    starts = {e.stage: e.reason for e in scene.run() if isinstance(e, Started)}
    assert starts["shout"] == "new words (read changed)"
    assert starts["export"] == "new shout (shout changed), new words (read changed)"


def test_a_raised_version_and_a_new_program_remake_a_stage(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.run()
    newer = [replace(read, version=2), *STAGES[1:]]
    scene.pipeline = Pipeline(Letters, newer, scene.pipeline.store)
    assert scene.reasons()["read"] == "stage version 1 -> 2"
    monkeypatch.setattr("refdgs_pipe.pipeline.plan.version", lambda name: "99")
    scene.pipeline = Pipeline(Letters, STAGES, scene.pipeline.store)
    assert scene.reasons()["read"].startswith("pydantic ")
    assert scene.reasons()["read"].endswith(" -> 99")


def test_the_record_names_the_device_of_a_stage_whose_result_depends_on_it(scene: Scene) -> None:
    stages = [replace(stage, by_device=stage.name == "read") for stage in STAGES]
    scene.pipeline = Pipeline(Letters, stages, scene.pipeline.store)
    scene.run(device=lambda: "cuda")
    measures = {name: scene.pipeline.store.current(name) for name in ("read", "export")}
    named = {n: ("device", "cuda", "") in found.measures for n, found in measures.items() if found}
    assert named == {"read": True, "export": False}


def test_until_makes_a_stage_and_what_it_needs(scene: Scene) -> None:
    assert made(scene.run(until="shout")) == ["read", "shout"]


def test_force_remakes_one_stage_and_what_follows_only_if_the_output_changed(scene: Scene) -> None:
    scene.run()
    assert made(scene.run(force=frozenset({"read"}))) == ["read"]
    assert made(scene.run(force=scene.pipeline.following("shout"))) == ["shout", "export"]


def test_the_same_photos_elsewhere_give_the_same_keys(scene: Scene, tmp_path: Path) -> None:
    scene.run()
    moved = Scene(tmp_path / "moved")
    moved.pipeline = Pipeline(Letters, STAGES, Store(moved.root / "work"))
    (scene.root / "work").rename(moved.root / "work")
    assert made(moved.run()) == []


def test_the_newest_export_is_published_whole(scene: Scene) -> None:
    scene.run(publish=PUBLISH)
    asset = scene.root / "work" / "asset"
    assert (asset / "text").read_text() == scene.page
    assert (asset / "parts" / "0.bin").exists()
    scene.settings["shout"] = ShoutParams(marks=5)
    scene.run(publish=PUBLISH)
    assert (asset / "text").read_text() == scene.page
    scene.settings = dict(SETTINGS)
    scene.run(publish=PUBLISH)
    assert (asset / "text").read_text() == scene.page
    assert [p.name for p in asset.parent.iterdir() if "new" in p.name or "old" in p.name] == []


def test_a_published_file_that_was_deleted_comes_back(scene: Scene) -> None:
    scene.run(publish=PUBLISH)
    (scene.root / "work" / "asset" / "text").unlink()
    scene.run(publish=PUBLISH)
    assert (scene.root / "work" / "asset" / "text").exists()


@pytest.mark.parametrize("name", ["text", MANIFEST])
def test_a_result_of_another_size_is_set_aside_and_made_again(scene: Scene, name: str) -> None:
    scene.run()
    whole, folder = scene.page, scene.folder("shout")
    (folder / name).write_text("{}")
    assert scene.reasons()["shout"].startswith("damaged: ")
    log = scene.run()
    assert [e.stage for e in log if isinstance(e, Damaged)] == ["shout"]
    assert made(log) == ["shout"]
    assert scene.page == whole
    assert (folder.parent / f".damaged-{folder.name}" / name).read_text() == "{}"


def test_a_changed_byte_is_found_when_the_result_is_needed(scene: Scene) -> None:
    scene.run()
    whole, path = scene.page, scene.folder("shout") / "parts" / "0.bin"
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    scene.settings["export"] = PrintParams(width=30)
    log = scene.run()
    assert made(log) == ["shout", "export"]
    reasons = [e.reason for e in log if isinstance(e, Started)]
    assert "content was changed" in reasons[0]
    scene.settings = dict(SETTINGS)
    assert scene.page == whole


def test_a_damaged_result_is_found_before_it_is_published(scene: Scene) -> None:
    scene.run(publish=PUBLISH)
    path = scene.folder("export") / "text"
    path.write_text("x" * path.stat().st_size)
    (scene.root / "work" / "asset" / "text").unlink()
    assert made(scene.run(publish=PUBLISH)) == ["export"]
    assert (scene.root / "work" / "asset" / "text").read_text().startswith("HELLO")


class OldShoutParams(Params):
    """Shouting, when `volume` was a setting."""

    marks: int = 1
    mood: str = "calm"
    volume: str = "low"


@pytest.mark.parametrize("volume", ["low", "high"])
def test_results_of_a_setting_that_is_none_any_more_still_count(scene: Scene, volume: str) -> None:
    former = [STAGES[0], replace(STAGES[1], params=OldShoutParams), STAGES[2]]
    new, scene.pipeline = scene.pipeline, Pipeline(Letters, former, scene.pipeline.store)
    scene.settings["shout"] = OldShoutParams(volume=volume)
    scene.run()
    scene.pipeline, scene.settings = new, dict(SETTINGS)
    assert made(scene.run()) == []
    scene.settings["shout"] = ShoutParams(marks=2)
    assert scene.reasons()["shout"] == "marks 1 -> 2"


def test_work_begun_with_a_setting_that_is_none_any_more_is_gone_on_with(scene: Scene) -> None:
    begun = ShoutParams().hashed()[1]
    assert begun["volume"] == "high"
    scene.run(until="read")
    mark = scene.pipeline.fingerprint(scene.source)
    origin = scene.pipeline.status(mark, scene.settings)[1].origin
    assert origin is not None
    (scene.pipeline.store.scratch(replace(origin, params=begun)) / "done").write_text("7")
    scene.run()
    (step,) = [s for s in scene.pipeline.status(mark, scene.settings) if s.stage.name == "shout"]
    assert step.manifest is not None and step.manifest.measures[0] == ("resumed at", 7, "")


def test_measures_and_warnings_stay_with_the_result(scene: Scene) -> None:
    (scene.letters / "1.txt").write_text("odd")
    log = scene.run()
    assert Warned("read", "an odd letter") in log
    step = run(scene.pipeline, scene.source, scene.settings, lambda event: None)[0]
    assert step.manifest is not None
    assert step.manifest.warnings == ("an odd letter",)
    assert step.manifest.measures == (("letters", 3, ""),)


def test_stopping_keeps_what_is_finished_and_resumes_from_scratch(scene: Scene) -> None:
    stop, log = threading.Event(), list[Event]()

    def listen(event: Event) -> None:
        log.append(event)
        if getattr(event, "note", "") == "loudness 6":
            stop.set()

    with pytest.raises(Cancelled, match="shouting"):
        run(scene.pipeline, scene.source, scene.settings, listen, Request(stop=stop))
    assert made(scene.run()) == ["shout", "export"]
    steps = run(scene.pipeline, scene.source, scene.settings, log.append)
    assert steps[1].manifest is not None
    assert steps[1].manifest.measures == (("resumed at", 7, ""),)
    assert not list((scene.root / "work" / "shout").glob(".[sp]*"))


def test_an_error_in_a_stage_leaves_nothing_half_made(scene: Scene) -> None:
    scene.settings["shout"] = ShoutParams(mood="mute")
    with pytest.raises(MeshError):
        scene.run()
    names = [path.name for path in (scene.root / "work" / "shout").iterdir()]
    assert [name.partition("-")[0] for name in names] == [".scratch"]


def test_an_adopted_file_rules_until_its_inputs_change(scene: Scene) -> None:
    scene.run()
    mine = scene.root / "mine.txt"
    mine.write_text("HAND MADE")
    mark = scene.pipeline.fingerprint(scene.source)
    scene.pipeline.adopt("shout", mine, mark, scene.settings)
    assert scene.reasons()["shout"] == "adopted from mine.txt"
    assert made(scene.run()) == ["export"]
    assert scene.page.startswith("HAND MADE (hello")
    scene.settings["shout"] = ShoutParams(marks=2)
    assert scene.reasons()["shout"] == "marks 1 -> 2, adopted file set aside"
    assert made(scene.run()) == ["shout", "export"]
    scene.settings = dict(SETTINGS)
    assert made(scene.run()) == []
    assert scene.page.startswith("HAND MADE")
    assert scene.pipeline.drop_adopted("shout")
    assert made(scene.run()) == []
    assert scene.page.startswith("HELLO THERE")


def test_asking_for_a_stage_again_drops_the_adopted_file(scene: Scene) -> None:
    scene.run()
    mine = scene.root / "mine.txt"
    mine.write_text("HAND MADE")
    scene.pipeline.adopt("shout", mine, scene.pipeline.fingerprint(scene.source), scene.settings)
    assert made(scene.run(force=frozenset({"shout"}))) == ["shout"]
    assert scene.page.startswith("HELLO THERE")


def test_only_some_stages_adopt(scene: Scene) -> None:
    mark = scene.pipeline.fingerprint(scene.source)
    with pytest.raises(InputError, match=r"read cannot adopt a file. These can: shout"):
        scene.pipeline.adopt("read", scene.letters / "0.txt", mark, scene.settings)
    with pytest.raises(InputError, match="waits for read"):
        scene.pipeline.adopt("shout", scene.letters / "0.txt", mark, scene.settings)
    with pytest.raises(InputError, match="no such file"):
        scene.pipeline.adopt("shout", scene.root / "none", mark, scene.settings)


def test_clean_keeps_what_the_settings_use(scene: Scene) -> None:
    scene.run(publish=PUBLISH)
    old = scene.folder("shout")
    scene.settings["shout"] = ShoutParams(marks=3)
    scene.run(publish=PUBLISH)
    mark = scene.pipeline.fingerprint(scene.source)
    gone = scene.pipeline.clean(mark, scene.settings)
    assert old in gone and len(gone) == 2
    assert not old.exists()
    assert made(scene.run()) == []
    assert (scene.root / "work" / "asset" / "text").exists()


def test_clean_keeps_what_the_last_run_used_while_a_new_one_is_unfinished(scene: Scene) -> None:
    scene.run()
    scene.settings["shout"] = ShoutParams(marks=3)
    assert scene.pipeline.clean(scene.pipeline.fingerprint(scene.source), scene.settings) == []


def test_a_wrong_wiring_is_refused(scene: Scene) -> None:
    with pytest.raises(InputError, match="no stage before shout makes its Words"):
        Pipeline(Letters, STAGES[1:], scene.pipeline.store)
    with pytest.raises(InputError, match="a stage before read makes Words too"):
        Pipeline(Letters, [read, read], scene.pipeline.store)
    with pytest.raises(InputError, match="no stage is called 'shot'"):
        scene.pipeline.stage("shot")


def test_a_stage_is_declared_by_its_signature() -> None:
    @stage(version=7, programs=("numpy",))
    def both(a: Words, b: Shout, params: ShoutParams, job: Job) -> Page:
        return Page(a.text + b.text)

    assert (both.name, both.version, both.programs) == ("both", 7, ("numpy",))
    assert both.inputs == {"a": Words, "b": Shout}
    assert (both.params, both.output) == (ShoutParams, Page)


def test_the_last_time_is_the_estimate_for_the_next(scene: Scene) -> None:
    seconds = next(e.seconds for e in scene.run() if isinstance(e, Finished) and e.stage == "shout")
    log = scene.run(force=frozenset({"shout"}))
    assert next(e for e in log if isinstance(e, Started)).expected_s == seconds
