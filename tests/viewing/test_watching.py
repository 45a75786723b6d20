"""What a view sees in a workspace: results, damage, checkpoints, and whether a run goes on."""

import os
import socket
import time
from dataclasses import replace
from pathlib import Path

import finished
import pytest

from refdgs_pipe.pipeline.catalog import STAGES
from refdgs_pipe.pipeline.store import Origin, Record, Store
from refdgs_pipe.viewing.story import Story
from refdgs_pipe.viewing.watching import Watch, is_held


def work(root: Path, until: str = "evaluate") -> Store:
    """A workspace with the results of all stages up to one."""
    store = Store(root)
    for step in finished.steps(store, until=until):
        if step.origin is not None:
            store.use(step.origin)
    return store


def test_a_place_without_a_workspace_has_nothing_in_it(tmp_path: Path) -> None:
    for root in (tmp_path / "none", tmp_path):
        seen = Watch(root, STAGES).look()
        assert (seen.results, seen.troubles, seen.begun, seen.is_running) == ({}, {}, None, False)


def test_finished_results_are_found_and_looking_writes_nothing(tmp_path: Path) -> None:
    work(tmp_path, until="gate")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    watch = Watch(tmp_path, STAGES)
    seen = watch.look()
    assert list(seen.results) == ["ingest", "sfm", "gate"]
    assert abs(seen.results["gate"].made - time.time()) < 100
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    assert watch.look().results["gate"] is seen.results["gate"]


def test_a_result_with_a_damaged_file_is_a_sentence(tmp_path: Path) -> None:
    store = work(tmp_path, until="gate")
    found = store.current("gate")
    assert found is not None
    (store.folder(found.origin) / "model.json").write_text("{}")
    seen = Watch(tmp_path, STAGES).look()
    assert "gate" not in seen.results
    assert "model.json: 2 bytes" in seen.troubles["gate"]


def test_a_result_that_was_replaced_is_another_one(tmp_path: Path) -> None:
    store = work(tmp_path, until="gate")
    watch = Watch(tmp_path, STAGES)
    before = watch.look().results["gate"].mark
    found = store.current("gate")
    assert found is not None
    store.put_aside(store.folder(found.origin))
    assert "gate" not in watch.look().results
    partial = store.partial(found.origin)
    finished.model().save(partial)
    store.commit(partial, found.origin, Record(1.0, {}))
    assert watch.look().results["gate"].mark != before


def test_a_result_that_was_made_from_other_cameras_is_an_older_one(tmp_path: Path) -> None:
    store = work(tmp_path, until="refine")
    gate, refine = store.current("gate"), store.current("refine")
    assert gate is not None
    assert refine is not None
    for digest, is_older in ((gate.digest, False), ("0" * 32, True)):
        origin = replace(refine.origin, inputs={"model": digest})
        partial = store.partial(origin)
        finished.field().save(partial)
        store.commit(partial, origin, Record(1.0, {}))
        store.use(origin)
        seen = Watch(tmp_path, STAGES).look()
        assert ("refine" in seen.older, "refine" in seen.results) == (is_older, not is_older)


def test_a_checkpoint_counts_until_the_cameras_are_newer(tmp_path: Path) -> None:
    store = work(tmp_path, until="start")
    path = store.scratch(Origin("train", 1, {}, {})) / "checkpoint.safetensors"
    path.write_bytes(b"any")
    watch = Watch(tmp_path, STAGES)
    later = time.time() + 60
    os.utime(path, (later, later))
    begun = watch.look().begun
    assert begun is not None
    assert (begun.path, begun.stage) == (path, "train")
    os.utime(path, (1, 1))
    assert watch.look().begun is None


def test_a_run_is_seen_by_who_holds_the_lock(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with store.lock():
        assert is_held(tmp_path, Story())
    assert not is_held(tmp_path, Story())  # this process lives on, and has let go


def test_the_work_of_a_run_is_told_while_it_holds_the_lock(tmp_path: Path) -> None:
    store, watch = Store(tmp_path), Watch(tmp_path, STAGES)
    with store.lock():
        seen = watch.look()
        assert seen.run_s == pytest.approx(sum(os.times()[:4]), abs=1.0)
    assert watch.look().run_s is None
    end = sum(os.times()[:4]) + 0.3
    while sum(os.times()[:4]) < end:  # as a run does that draws its report
        pass
    assert watch.look().run_s is not None
    assert watch.look().run_s is None  # and as one that only waits


def test_on_another_machine_a_run_is_seen_by_its_log(tmp_path: Path) -> None:
    (tmp_path / ".lock-owner").write_text("1 some-other-machine")
    assert is_held(tmp_path, Story(told=time.time()))
    assert not is_held(tmp_path, Story(told=time.time() - 1000))


@pytest.mark.parametrize("note", ["", "x y", "999999999 ", f"999999999 {socket.gethostname()}"])
def test_a_holder_that_is_none_does_not_count(tmp_path: Path, note: str) -> None:
    (tmp_path / ".lock-owner").write_text(note)
    assert not is_held(tmp_path, Story(told=time.time()))
