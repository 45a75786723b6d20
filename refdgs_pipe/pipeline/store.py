"""Results on disk. A result is one folder `<stage>/<key>`: complete or absent, never changed.

The key is a hash of the result's origin: the stage, its version, its parameters, the digests
(content hashes) of its inputs, and the versions of the programs it declares. An equal key means
that the result can be reused.
"""

import hashlib
import json
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from refdgs_pipe.errors import CorruptError, WorkspaceBusy
from refdgs_pipe.pipeline.atomic import (
    disk_errors,
    publish,
    remove,
    rescue,
    sync,
    sync_tree,
    write_json,
)
from refdgs_pipe.pipeline.fingerprint import combine, hash_file

MANIFEST = "manifest.json"
CURRENT = ".current"  # the key that the last run used
ADOPTED = ".adopted"  # which key a user's own file stands in for
PUBLISHED = ".published"
SCHEMA = 1  # raised when the layout of results changes


@dataclass(frozen=True)
class Origin:
    """Everything a result depends on."""

    stage: str
    version: int
    params: dict[str, Any]
    inputs: dict[str, str]  # argument -> digest of the artifact
    programs: dict[str, str] = field(default_factory=dict)  # distribution -> version
    adopted: str | None = None  # digest of the user's file that replaces the stage's work
    schema: int = SCHEMA

    @property
    def key(self) -> str:
        text = json.dumps(asdict(self), sort_keys=True, separators=(",", ":"))
        return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


@dataclass(frozen=True)
class Manifest:
    """The record kept beside each result.

    Args:
        files: name -> (bytes, hash) of every file of the result.
        source_files: name -> hash of the photos it was made from, for the stage that reads them.
        measures: (name, value, unit) as the stage reported them.
        note: where an adopted result came from.
    """

    origin: Origin
    digest: str
    seconds: float
    made_utc: str
    files: dict[str, tuple[int, str]]
    source_files: dict[str, str]
    measures: tuple[tuple[str, float | int | str, str], ...] = ()
    warnings: tuple[str, ...] = ()
    note: str = ""

    @classmethod
    def read(cls, folder: Path) -> "Manifest":
        """Read the record of a result.

        Raises:
            CorruptError: it is missing or not one of ours.
        """
        try:
            record = json.loads((folder / MANIFEST).read_text("utf-8"))
            origin = Origin(**record.pop("origin"))
            files = {name: (int(size), str(h)) for name, (size, h) in record.pop("files").items()}
            measures = tuple((n, v, unit) for n, v, unit in record.pop("measures"))
            warnings = tuple(record.pop("warnings"))
            return cls(origin, files=files, measures=measures, warnings=warnings, **record)
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise CorruptError(f"{folder / MANIFEST}: not readable ({error})") from None


@dataclass(frozen=True)
class Record:
    """What a stage said about its result while making it."""

    seconds: float
    source_files: dict[str, str]
    measures: tuple[tuple[str, float | int | str, str], ...] = ()
    warnings: tuple[str, ...] = ()
    note: str = ""


class Store:
    """The results of one workspace. Only the holder of `lock` may change them."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._is_locked = False

    def folder(self, origin: Origin) -> Path:
        """Where the result with this origin is, or would be."""
        return self.root / origin.stage / origin.key

    def knows(self, origin: Origin) -> bool:
        """Whether a result with this origin is there, was begun, or is stood in for."""
        begun = self.folder(origin).is_dir() or self._scratch(origin).is_dir()
        return begun or self.adoption(origin) != origin

    def find(self, origin: Origin) -> Manifest | None:
        """The record of a finished result, after a look at its files' sizes.

        Raises:
            CorruptError: it is there, but damaged.
        """
        folder = self.folder(origin)
        if not folder.is_dir():
            return None
        manifest = Manifest.read(folder)
        check_sizes(folder, manifest)
        return manifest

    def current(self, stage: str) -> Manifest | None:
        """The result of a stage that the last run used, whatever its origin; damaged ones aside."""
        with suppress(OSError, CorruptError):
            key = (self.root / stage / CURRENT).read_text("utf-8").strip()
            return Manifest.read(self.root / stage / key)
        return None

    def use(self, origin: Origin) -> None:
        """Remember that this run uses this result."""
        note = self.root / origin.stage / CURRENT
        with suppress(OSError):
            if note.read_text("utf-8") == origin.key:
                return
        with suppress(OSError):  # it only serves the words of `status`
            note.write_text(origin.key, "utf-8")

    def partial(self, origin: Origin) -> Path:
        """An empty folder to build a result in."""
        folder = self.folder(origin).with_name(f".partial-{origin.key}")
        remove(folder)
        folder.mkdir(parents=True)
        return folder

    def scratch(self, origin: Origin) -> Path:
        """A folder that survives an interruption, so that a long stage can resume."""
        folder = self._scratch(origin)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def drop_scratch(self, origin: Origin) -> None:
        """Delete what a finished stage kept for resuming."""
        remove(self._scratch(origin))

    def commit(self, partial: Path, origin: Origin, record: Record) -> Manifest:
        """Publish a result with one rename: readers see all of it or nothing.

        Raises:
            WriteError: the disk is full or cannot be written. Nothing finished is lost.
        """
        with disk_errors(self.root):
            names = (path for path in partial.rglob("*") if path.is_file())
            files = {
                path.relative_to(partial).as_posix(): (path.stat().st_size, hash_file(path))
                for path in sorted(names)
            }
            digest = combine({name: content for name, (_, content) in files.items()})
            made = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
            manifest = Manifest(origin, digest, made_utc=made, files=files, **vars(record))
            sync_tree(partial)
            write_json(partial / MANIFEST, asdict(manifest))
            publish(partial, self.folder(origin))
            sync(self.root)
            self.drop_scratch(origin)
        return manifest

    def sweep(self) -> None:
        """Delete what killed runs left half-made. Scratch stays: it is there to resume from."""
        for pattern in ("*/.partial-*", "*/.trash-*", ".trash-*", ".new-*"):
            for leftover in self.root.glob(pattern):
                remove(leftover)

    def set_aside(self, origin: Origin) -> Path:
        """Move a damaged result out of the way, for the user to look at. Return where it went."""
        folder = self.folder(origin)
        aside = folder.with_name(f".damaged-{origin.key}")
        with disk_errors(self.root):
            remove(aside)
            folder.rename(aside)
        return aside

    def adoption(self, origin: Origin) -> Origin:
        """The origin that stands in for this one: a user's own file, or itself."""
        with suppress(OSError, ValueError, KeyError, TypeError):
            note = json.loads((self.root / origin.stage / ADOPTED).read_text("utf-8"))
            if note["key"] == origin.key:
                return replace(origin, adopted=str(note["digest"]))
        return origin

    def adopt(self, origin: Origin) -> None:
        """Let the adopted `origin` stand in for the stage's own result from now on."""
        plain = replace(origin, adopted=None)
        with disk_errors(self.root):
            write_json(
                self.root / origin.stage / ADOPTED, {"key": plain.key, "digest": origin.adopted}
            )

    def drop_adoption(self, stage: str) -> bool:
        """Use the stage's own result again. False if there was no adopted one."""
        with disk_errors(self.root):
            try:
                (self.root / stage / ADOPTED).unlink()
            except FileNotFoundError:
                return False
        return True

    def publish(self, origin: Origin, manifest: Manifest, name: str) -> Path:
        """Let the folder `name` hold this result's files. A reader never sees half of them.

        Raises:
            CorruptError: the result is damaged.
            WriteError: the disk is full or cannot be written; the folder is as it was.
        """
        target, memory = self.root / name, self.root / PUBLISHED
        identity = {"key": origin.key, "digest": manifest.digest}
        with disk_errors(self.root):
            rescue(target)
            with suppress(OSError, ValueError, TypeError, CorruptError):
                if json.loads(memory.read_text("utf-8")) == identity:
                    check_sizes(target, manifest)
                    return target
            check_contents(self.folder(origin), manifest)
            new = target.with_name(f".new-{name}")
            remove(new)
            for file in manifest.files:
                (new / file).parent.mkdir(parents=True, exist_ok=True)
                (new / file).write_bytes((self.folder(origin) / file).read_bytes())
            sync_tree(new)
            publish(new, target)
            write_json(memory, identity)
        return target

    def unused(self, keep: Iterable[Origin]) -> list[Path]:
        """Every result but those in `keep`, and all that dead runs left behind."""
        kept = {path for origin in keep for path in (self.folder(origin), self._scratch(origin))}
        stages = (path for path in self.root.iterdir() if path.is_dir() and path.name[0] != ".")
        inside = (path for stage in stages for path in stage.iterdir() if path.is_dir())
        ours = (path for path in inside if _is_ours(path))
        leftovers = self.root.glob(".trash-*")
        return sorted(path for path in [*ours, *leftovers] if path not in kept)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes out. The system frees the lock if this process dies.

        Raises:
            WorkspaceBusy: another process holds it.
            WriteError: the workspace cannot be written.
        """
        from filelock import FileLock, Timeout

        if self._is_locked:  # by our caller
            yield
            return
        owner = self.root / ".lock-owner"
        with disk_errors(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.root / ".lock", timeout=0)
            try:
                lock.acquire()
            except Timeout:
                who = owner.read_text("utf-8") if owner.exists() else "another process"
                raise WorkspaceBusy(
                    f"{self.root}: {who} is working here. Wait for it, or stop it"
                ) from None
            owner.write_text(f"process {os.getpid()}", "utf-8")
        self._is_locked = True
        try:
            yield
        finally:
            self._is_locked = False
            lock.release()

    def _scratch(self, origin: Origin) -> Path:
        return self.folder(origin).with_name(f".scratch-{origin.key}")


def check_sizes(folder: Path, manifest: Manifest) -> None:
    """Compare a result's files with its record by size.

    Raises:
        CorruptError: a file is missing or has another size.
    """
    for name, (size, _) in manifest.files.items():
        try:
            found = (folder / name).stat().st_size
        except OSError:
            raise CorruptError(f"{folder / name}: missing") from None
        if found != size:
            raise CorruptError(f"{folder / name}: {found} bytes, {size} expected")


def check_contents(folder: Path, manifest: Manifest) -> None:
    """Compare a result's files with its record byte for byte.

    Raises:
        CorruptError: a file is missing or differs.
    """
    check_sizes(folder, manifest)
    for name, (_, content) in manifest.files.items():
        if hash_file(folder / name) != content:
            raise CorruptError(f"{folder / name}: its content was changed since it was made")


def _is_ours(path: Path) -> bool:
    """Whether a folder inside a stage's folder was made by the store."""
    prefixes = (".partial-", ".scratch-", ".trash-", ".damaged-", ".old-")
    return path.name.startswith(prefixes) or (path / MANIFEST).exists()
