"""Results that machines share, from the command line: what one made no other makes again."""

import shutil
from pathlib import Path

import pytest
from batches import BatchShell, needs_snakemake

pytest.importorskip("obstore", reason="obstore is not installed: the extra batch")


@pytest.fixture
def shell(tmp_path: Path) -> BatchShell:
    return BatchShell(tmp_path, forks=True)


def test_a_laptop_fetches_what_the_farm_made_and_makes_nothing(shell: BatchShell) -> None:
    made = shell.json("run", "letters", "--cache", "share")["made"]
    assert made == ["read", "shout", "export"]
    text = (shell.work / "asset" / "text").read_text()
    shutil.rmtree(shell.work)
    laptop = shell("run", "letters", "--cache", "share").stderr
    assert "shout: fetched" in laptop and "done in" not in laptop
    assert (shell.work / "asset" / "text").read_text() == text
    shell("verify", "letters.refdgs")


def test_what_was_finished_before_is_shared_by_a_later_run(shell: BatchShell) -> None:
    shell("run", "letters")
    shell("run", "letters", "--cache", "share")
    shutil.rmtree(shell.work)
    assert shell.json("run", "letters", "--cache", "share")["made"] == []


def test_a_changed_setting_makes_only_what_is_not_shared(shell: BatchShell) -> None:
    shell("run", "letters", "--cache", "share")
    shutil.rmtree(shell.work)
    made = shell.json("run", "letters", "--cache", "share", "--set", "export.width=30")["made"]
    assert made == ["export"]


def test_an_adopted_file_is_not_shared(shell: BatchShell) -> None:
    shell("run", "letters")
    (shell.root / "own.txt").write_text("mine")
    shell("adopt", "letters.refdgs", "shout", "own.txt")
    shell("run", "letters.refdgs", "--cache", "share")
    shutil.rmtree(shell.work)
    assert shell.json("run", "letters", "--cache", "share")["made"] == ["shout", "export"]


def test_poison_is_named_and_the_result_made_here(shell: BatchShell) -> None:
    shell("run", "letters", "--cache", "share")
    shutil.rmtree(shell.work)
    (record,) = (shell.root / "share" / "ac" / "shout").iterdir()
    record.write_text(record.read_text().replace('"seconds"', '"sec0nds"'))
    said = shell("run", "letters", "--cache", "share").stderr
    assert f"ac/shout/{record.name}" in said and "refused" in said and "shout: done" in said
    shutil.rmtree(shell.work)
    assert shell.json("run", "letters", "--cache", "share")["made"] == []  # it was replaced


def test_rerun_makes_a_stage_again_though_it_is_shared(shell: BatchShell) -> None:
    shell("run", "letters", "--cache", "share")
    found = shell.json("run", "letters", "--cache", "share", "--force", "shout")
    assert found["made"] == ["shout"]


def test_verify_and_gc_say_what_they_found(shell: BatchShell) -> None:
    shell("run", "letters", "--cache", "share")
    assert "0 damaged" in shell("cache", "verify", "share").stderr
    blob = next(path for path in (shell.root / "share" / "cas").rglob("*") if path.is_file())
    blob.write_bytes(b"")
    found = shell("cache", "verify", "share", code=74)
    assert str(blob) in found.stdout and "1 damaged" in found.stderr
    shell("cache", "verify", "share", "--delete", code=74)
    assert "0 damaged" in shell("cache", "verify", "share").stderr
    assert "would delete no results" in shell("cache", "gc", "share", "--dry-run").stderr
    (shell.root / "keep.txt").write_text("# mine\nletters.refdgs\nshout/0123456789abcdef\n")
    said = shell("cache", "gc", "share", "--older-than", "0h", "--keep", "keep.txt").stderr
    assert "deleted" in said
    assert "expected an age" in shell("cache", "gc", "share", "--older-than", "x", code=64).stderr


@needs_snakemake
def test_a_batch_in_another_place_computes_nothing(shell: BatchShell) -> None:
    shell.init("--cache", "share", ball="hello", cup="world")
    shell("batch", "run", "B", "--cores", "2")
    shutil.rmtree(shell.batch)
    shell.init("--cache", "share", ball="hello", cup="world")
    shell("batch", "run", "B", "--cores", "2")
    parts = [
        shell.result(name, part)
        for name in ("ball", "cup")
        for part in ("prepare", "train", "finish")
    ]
    assert [part["made"] for part in parts] == [{}] * 6
    assert {stage for part in parts for stage in part["fetched"]} == {"read", "shout", "export"}
