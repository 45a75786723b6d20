"""A workspace from somebody else: what lies in it is not believed, and nothing else is touched."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_stages import PrintParams, ShoutParams
from letter_scene import PUBLISH, Scene, made

from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.pipeline.events import Damaged, Warned
from refdgs_pipe.pipeline.lock import OWNER, locked
from refdgs_pipe.pipeline.manifest import MANIFEST, Manifest, _checksum, check_contents


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    scene = Scene(tmp_path / "scene")
    scene.run(publish=PUBLISH)
    return scene


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A folder of the user's, outside of every workspace."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    (folder / "old.jsonl").write_text("{}")
    return folder


def content(folder: Path) -> dict[str, bytes]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def forge(folder: Path, change: Callable[[dict[str, Any]], None], *, sealed: bool = True) -> None:
    """Change a manifest as somebody would who knows how it is checked."""
    record = json.loads((folder / MANIFEST).read_text())
    record.pop("checksum", None)
    change(record)
    digest = {name: facts[1] for name, facts in record["files"].items()}
    from refdgs_pipe.pipeline.fingerprint import combine

    record["digest"] = combine(digest)
    (folder / MANIFEST).write_text(
        json.dumps(record | ({"checksum": _checksum(record)} if sealed else {}))
    )


@pytest.mark.parametrize(
    "name", ["../../../stolen", "/tmp/stolen", "a/../../b", "", "a\0b", "C:/x"]
)
def test_a_manifest_whose_names_leave_the_result_is_set_aside(scene: Scene, name: str) -> None:
    folder = scene.folder("export")

    def lead_out(record: dict[str, Any]) -> None:
        record["files"][name] = record["files"].pop("text")

    forge(folder, lead_out)
    shutil.rmtree(scene.root / "work" / "asset")
    before = sorted(scene.root.iterdir())
    log = scene.run(publish=PUBLISH)
    assert [e.stage for e in log if isinstance(e, Damaged)] == ["export"]
    assert made(log) == ["export"]
    assert sorted(scene.root.iterdir()) == before


def test_a_result_that_is_a_link_or_holds_one_is_set_aside(scene: Scene, mine: Path) -> None:
    part = scene.folder("shout") / "parts" / "0.bin"
    shutil.copy(part, mine / "0.bin")
    part.unlink()
    part.symlink_to(mine / "0.bin")
    before = content(mine)
    assert made(scene.run()) == ["shout"]
    parts = scene.folder("shout") / "parts"
    shutil.copytree(parts, mine / "parts")
    shutil.rmtree(parts)
    parts.symlink_to(mine / "parts")
    assert made(scene.run()) == ["shout"]
    assert before.items() <= content(mine).items()


def test_a_stage_folder_that_is_a_link_is_refused(scene: Scene, mine: Path) -> None:
    shutil.rmtree(scene.root / "work" / "shout")
    (scene.root / "work" / "shout").symlink_to(mine)
    before = content(mine)
    with pytest.raises(InputError, match="shout: is a link"):
        scene.run()
    assert content(mine) == before


@pytest.mark.parametrize("note", [".current", ".adopted"])
def test_a_note_that_is_a_link_is_replaced_and_not_followed(
    scene: Scene, mine: Path, note: str
) -> None:
    link = scene.root / "work" / "shout" / note
    link.unlink(missing_ok=True)
    link.symlink_to(mine / "thesis.txt")
    scene.run()
    letter = scene.root / "hand.txt"
    letter.write_text("MINE")
    mark = scene.pipeline.fingerprint(scene.source)
    scene.pipeline.adopt("shout", letter, mark, scene.settings)
    assert (mine / "thesis.txt").read_text() == "years of work"


def test_the_note_of_the_current_result_cannot_lead_elsewhere(scene: Scene) -> None:
    shutil.copytree(scene.folder("shout"), scene.root / "work" / "export" / "elsewhere")
    (scene.root / "work" / "shout" / ".current").write_text("../export/elsewhere")
    assert scene.pipeline.store.current("shout") is None


def test_a_lock_that_is_a_link_is_refused_and_its_target_left_alone(
    scene: Scene, mine: Path
) -> None:
    lock = scene.root / "work" / ".lock"
    lock.unlink()
    lock.symlink_to(mine / "thesis.txt")
    with pytest.raises(InputError, match="is a link"):
        scene.run()
    assert (mine / "thesis.txt").read_text() == "years of work"


def test_clean_leaves_alone_what_is_not_ours(scene: Scene, mine: Path) -> None:
    work = scene.root / "work"
    own = [work / "notes" / "0123456789abcdef", work / "notes" / ".trash-mine", work / ".trash-me"]
    own += [work / "shout" / "my model", work / "shout" / ".trash-mine", work / "blend" / ".old-x"]
    for folder in own:
        folder.mkdir(parents=True)
        (folder / MANIFEST).write_text("mine")
    (work / "read" / "fedcba9876543210").symlink_to(mine)
    (work / "link").symlink_to(mine)
    before = content(mine)
    scene.settings["shout"] = ShoutParams(marks=4)
    scene.run(publish=PUBLISH)
    gone = scene.pipeline.clean(scene.pipeline.fingerprint(scene.source), scene.settings)
    assert len(gone) == 2
    assert all((folder / MANIFEST).read_text() == "mine" for folder in own)
    assert content(mine) == before and (work / "link").is_symlink()


def test_files_of_the_user_in_the_asset_folder_are_kept(scene: Scene) -> None:
    asset = scene.root / "work" / "asset"
    (asset / "scene.blend").write_text("mine")
    scene.settings["export"] = PrintParams(width=30)
    log = scene.run(publish=PUBLISH)
    assert any(isinstance(event, Warned) and "asset.kept" in event.text for event in log)
    assert (asset.with_name("asset.kept") / "scene.blend").read_text() == "mine"
    assert sorted(content(asset)) == sorted(Manifest.read(scene.folder("export")).files)
    scene.settings["export"] = PrintParams(width=40)
    scene.run(publish=PUBLISH)
    assert not asset.with_name("asset.kept-2").exists()


def test_an_asset_folder_that_was_there_before_is_kept(tmp_path: Path) -> None:
    scene = Scene(tmp_path)
    (tmp_path / "work" / "asset").mkdir(parents=True)
    (tmp_path / "work" / "asset" / "own.txt").write_text("mine")
    scene.run(publish=PUBLISH)
    assert (tmp_path / "work" / "asset.kept" / "own.txt").read_text() == "mine"


def test_a_published_folder_that_is_a_link_is_replaced(scene: Scene, mine: Path) -> None:
    asset = scene.root / "work" / "asset"
    shutil.rmtree(asset)
    asset.symlink_to(mine)
    before = content(mine)
    scene.run(publish=PUBLISH)
    assert content(mine) == before
    assert asset.is_dir() and not asset.is_symlink()


def test_a_changed_byte_of_the_published_asset_is_mended(scene: Scene) -> None:
    path = scene.root / "work" / "asset" / "text"
    whole = path.read_bytes()
    path.write_bytes(b"x" * len(whole))
    scene.run(publish=PUBLISH)
    assert path.read_bytes() == whole


def test_a_result_copied_under_another_key_is_not_reused(scene: Scene) -> None:
    calm = scene.folder("shout")
    scene.settings["shout"] = ShoutParams(marks=3)
    mark = scene.pipeline.fingerprint(scene.source)
    origin = scene.pipeline.status(mark, scene.settings)[1].origin
    assert origin is not None
    shutil.copytree(calm, calm.with_name(origin.key))
    assert made(scene.run()) == ["shout", "export"]
    assert "!!!" in scene.page


def test_every_flipped_byte_of_a_manifest_is_found(scene: Scene) -> None:
    folder = scene.folder("shout")
    path = folder / MANIFEST
    whole = path.read_bytes()
    manifest = Manifest.read(folder)
    taken = []
    for at in range(len(whole)):
        for flip in (0x01, 0x10, 0x80):
            data = bytearray(whole)
            data[at] ^= flip
            path.write_bytes(data)
            try:
                found = Manifest.read(folder)
            except CorruptError:
                continue
            if found != manifest:
                taken.append((at, flip))
    assert taken == []


def test_a_manifest_of_before_there_were_checksums_is_read_and_checked(scene: Scene) -> None:
    folder = scene.folder("shout")
    manifest = Manifest.read(folder)
    forge(folder, lambda record: None, sealed=False)
    assert Manifest.read(folder) == manifest
    forge(folder, lambda record: record["origin"].update(version=9), sealed=False)
    with pytest.raises(CorruptError, match="is the record of"):
        Manifest.read(folder)


def test_a_result_with_hashes_of_128_bits_is_still_checked(scene: Scene) -> None:
    folder = scene.folder("shout")

    def with_hashes(size: int) -> None:
        def change(record: dict[str, Any]) -> None:
            for name, facts in record["files"].items():
                data = (folder / name).read_bytes()
                facts[1] = hashlib.blake2b(data, digest_size=size).hexdigest()

        forge(folder, change)

    with_hashes(16)
    older = Manifest.read(folder)
    assert len(older.digest) == 32
    check_contents(folder, older)
    with_hashes(1)  # as short as that, a hash proves nothing
    with pytest.raises(CorruptError, match="content was changed"):
        check_contents(folder, Manifest.read(folder))
    file = folder / next(iter(older.files))
    file.write_bytes(file.read_bytes()[::-1])
    with pytest.raises(CorruptError, match="content was changed"):
        check_contents(folder, older)


def test_a_file_that_was_added_to_a_result_is_damage(scene: Scene) -> None:
    (scene.folder("shout") / "points.npz").write_bytes(b"")
    scene.settings["export"] = PrintParams(width=30)
    assert made(scene.run()) == ["shout", "export"]


def test_a_result_that_only_an_exchange_in_two_steps_moved_is_rescued(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = scene.folder("shout")
    folder.rename(folder.with_name(f".old-{folder.name}"))
    assert made(scene.run()) == []
    folder.rename(folder.with_name(f".old-{folder.name}"))
    mark = scene.pipeline.fingerprint(scene.source)
    assert scene.pipeline.clean(mark, scene.settings) == []
    assert folder.is_dir()


def test_half_written_notes_of_dead_processes_are_swept(scene: Scene) -> None:
    work, dead = scene.root / "work", 2**22 + 1
    old = [work / f".workspace.json-{dead}", work / "shout" / f"..current-{dead}"]
    kept = [
        work / f".workspace.json-{os.getpid()}",
        work / f".mine-{dead}",
        work / ".workspace.json-x",
    ]
    for path in (*old, *kept):
        path.write_text("{")
        os.utime(path, (0, 0))
    scene.run()
    assert not any(path.exists() for path in old)
    assert all(path.exists() for path in kept)


def test_a_busy_workspace_names_no_process_that_is_dead(tmp_path: Path) -> None:
    with locked(tmp_path):
        (tmp_path / OWNER).write_text(f"{2**22 + 1} {os.uname().nodename}")
        from refdgs_pipe.errors import WorkspaceBusy

        with pytest.raises(WorkspaceBusy, match="another process is working"), locked(tmp_path):
            pass
        (tmp_path / OWNER).write_text("17 other\x1bhost")
        with pytest.raises(WorkspaceBusy, match=r"process 17 on other\\x1bhost"), locked(tmp_path):
            pass


def test_a_file_system_without_locks_is_said_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import errno

    from filelock import _unix

    from refdgs_pipe.errors import SystemLimit

    for number in (errno.ENOSYS, errno.ENOLCK):

        def refuse(fd: int, number: int = number) -> bool:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(_unix, "lock_fd_nonblocking", refuse)
        with pytest.raises(SystemLimit, match="local disk"), locked(tmp_path):
            pass
    assert not (tmp_path / ".lock").is_symlink()
