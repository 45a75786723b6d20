"""Results on disk. A result is one folder `<stage>/<key>`: complete or absent, never changed.

The key is a hash of the result's origin: the stage, its version, its parameters, the digests
(content hashes) of its inputs, and the versions of the programs it declares. An equal key means
that the result can be reused.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from os import stat_result
from pathlib import Path
from typing import TypeVar

from refdgs_pipe.documents import parse_json, read_text
from refdgs_pipe.errors import CorruptError, InputError, RefdgsError
from refdgs_pipe.formatting import printable
from refdgs_pipe.pipeline import leftovers
from refdgs_pipe.pipeline.atomic import (
    disk_errors,
    publish,
    remove,
    rescue,
    sync,
    sync_tree,
    write_json,
    write_text,
)
from refdgs_pipe.pipeline.fingerprint import hash_file
from refdgs_pipe.pipeline.lock import locked
from refdgs_pipe.pipeline.manifest import (
    KEY,
    MANIFEST,
    MISSING,
    Manifest,
    Origin,
    Record,
    check_contents,
    check_sizes,
    digest_of,
    visible,
)
from refdgs_pipe.pipeline.stage import Artifact
from refdgs_pipe.trouble import raise_if_machine

T = TypeVar("T", bound=Artifact)

__all__ = ["MANIFEST", "Manifest", "Origin", "Record", "Store", "check_contents", "check_sizes"]

CURRENT = ".current"  # the key that the last run used
ADOPTED = ".adopted"  # which key a user's own file stands in for
PUBLISHED = ".published"
_NOTE = 10_000  # bytes at most of one of our notes


class Store:
    """The results of one workspace. Only the holder of `lock` may change them."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._is_locked = False
        self._sound: dict[Path, list[object]] = {}  # whole results, with their files' times

    def folder(self, origin: Origin) -> Path:
        """Where the result with this origin is, or would be."""
        return self.root / origin.stage / origin.key

    def _stage(self, stage: str) -> Path:
        """The folder of a stage's results, to write in.

        Raises:
            InputError: it is a link.
        """
        folder = self.root / stage
        if folder.is_symlink():
            raise InputError(f"{folder}: is a link. A workspace holds no links: move it back")
        return folder

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

    def check(self, manifest: Manifest) -> Path:
        """Compare a result with its record byte for byte, and return its folder.

        What this process found whole is not read again while its files' times stay the same.

        Raises:
            CorruptError: it is damaged.
        """
        folder = self.folder(manifest.origin)
        times = _times(folder, manifest)
        if not times or self._sound.get(folder) != times:
            check_contents(folder, manifest)
            self._sound[folder] = _times(folder, manifest)
        return folder

    def current(self, stage: str) -> Manifest | None:
        """The result of a stage that the last run used, whatever its origin; damaged ones aside."""
        with suppress(*MISSING, ValueError, CorruptError):
            key = self._note(stage, CURRENT).strip()
            if KEY.fullmatch(key):
                return Manifest.read(self.root / stage / key)
        return None

    def use(self, origin: Origin) -> None:
        """Remember that this run uses this result."""
        with suppress(OSError, ValueError):
            if self._note(origin.stage, CURRENT) == origin.key:
                return
        with suppress(OSError):  # it only serves the words of `status`
            write_text(self._stage(origin.stage) / CURRENT, origin.key, durable=False)

    def _note(self, stage: str, name: str) -> str:
        """One of our notes in a stage's folder; a link is none."""
        return read_text(self.root / stage / name, limit=_NOTE, follow=False)

    def partial(self, origin: Origin) -> Path:
        """An empty folder to build a result in."""
        folder = self._stage(origin.stage) / f".partial-{origin.key}"
        remove(folder)
        folder.mkdir(parents=True)
        return folder

    def scratch(self, origin: Origin) -> Path:
        """A folder that survives an interruption, so that a long stage can resume."""
        folder = self._stage(origin.stage) / self._scratch(origin).name
        if folder.is_symlink():
            raise InputError(f"{folder}: is a link. A workspace holds no links: delete it")
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
            digest = digest_of(files)
            made = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
            manifest = Manifest(origin, digest, made_utc=made, files=files, **vars(record))
            self._publish_result(partial, manifest)
        return manifest

    def receive(self, manifest: Manifest, fill: Callable[[Path], None]) -> None:
        """Publish a result that was made elsewhere, as `commit` publishes ours.

        Args:
            fill: writes the files into an empty folder, each compared with its hash.

        Raises:
            CorruptError: the files are not those of the record.
            WriteError: the disk is full or cannot be written.
        """
        with disk_errors(self.root):
            partial = self.partial(manifest.origin)
            try:
                fill(partial)
                check_sizes(partial, manifest)
                self._publish_result(partial, manifest)
            except Exception:
                remove(partial)
                raise

    def _publish_result(self, partial: Path, manifest: Manifest) -> None:
        """Write the record last, and give the folder its name."""
        folder = self.folder(manifest.origin)
        sync_tree(partial)
        write_json(partial / MANIFEST, manifest.record())
        publish(partial, folder)
        self._sound[folder] = _times(folder, manifest)
        sync(self.root)
        self.drop_scratch(manifest.origin)

    def sweep(self, stages: Iterable[str]) -> None:
        """Delete what killed runs left half-made, of these stages and of published folders."""
        with disk_errors(self.root):
            leftovers.sweep(self.root, stages)

    def set_aside(self, origin: Origin) -> Path:
        """Move a damaged result out of the way, for the user to look at. Return where it went."""
        return self.put_aside(self.folder(origin))

    def put_aside(self, folder: Path) -> Path:
        """`set_aside`, of a result whose record may not even be readable."""
        aside = folder.with_name(f".damaged-{folder.name}")
        with disk_errors(self.root):
            remove(aside)
            folder.rename(aside)
        self._sound.pop(folder, None)
        return aside

    def adoption(self, origin: Origin) -> Origin:
        """The origin that stands in for this one: a user's own file, or itself."""
        with suppress(*MISSING, ValueError, KeyError, TypeError):
            note = parse_json(self._note(origin.stage, ADOPTED))
            if note["key"] == origin.key:
                return replace(origin, adopted=str(note["digest"]))
        return origin

    def adopt(self, origin: Origin) -> None:
        """Let the adopted `origin` stand in for the stage's own result from now on."""
        plain = replace(origin, adopted=None)
        with disk_errors(self.root):
            write_json(
                self._stage(origin.stage) / ADOPTED, {"key": plain.key, "digest": origin.adopted}
            )

    def drop_adoption(self, stage: str) -> bool:
        """Use the stage's own result again. False if there was no adopted one."""
        with disk_errors(self.root):
            try:
                (self._stage(stage) / ADOPTED).unlink()
            except FileNotFoundError:
                return False
        return True

    def publish(self, origin: Origin, manifest: Manifest, name: str) -> str | None:
        """Let the folder `name` hold this result's files. A reader never sees half of them.

        Returns:
            Where the folder that was there is now, if it held files of the user's; else None.

        Raises:
            CorruptError: the result is damaged.
            WriteError: the disk is full or cannot be written; the folder is as it was.
        """
        target, memory = self.root / name, self.root / PUBLISHED
        identity = {"key": origin.key, "digest": manifest.digest}
        known: dict[str, str] = {}
        with disk_errors(self.root):
            rescue(target)
            with suppress(*MISSING, ValueError, TypeError, KeyError, CorruptError):
                last = parse_json(read_text(memory, follow=False))
                known = dict(last.pop("files", {}))
                if last == identity:
                    check_contents(target, manifest)
                    return None
            source, new = self.check(manifest), target.with_name(f".new-{name}")
            remove(new)
            for file in manifest.files:
                (new / file).parent.mkdir(parents=True, exist_ok=True)
                (new / file).write_bytes((source / file).read_bytes())
            sync_tree(new)
            kept = self._keep_foreign(target, origin.stage, known)
            publish(new, target)
            files = {file: content for file, (_, content) in manifest.files.items()}
            write_json(memory, identity | {"files": files})
        return kept

    def _keep_foreign(self, target: Path, stage: str, known: dict[str, str]) -> str | None:
        """Move a published folder out of the way, if it holds what we did not put there.

        Args:
            known: name -> hash of what was last put there; a kill may have kept that from disk.
        """
        if not target.is_dir() or target.is_symlink() or not (there := visible(target)):
            return None
        if _holds_only(target, there, known):
            return None
        for folder in leftovers.results_in(self.root, [stage]):
            with suppress(CorruptError):
                made = {name: content for name, (_, content) in Manifest.read(folder).files.items()}
                if _holds_only(target, there, made):
                    return None
        number, aside = 1, target.with_name(f"{target.name}.kept")
        while aside.is_symlink() or aside.exists():
            number += 1
            aside = target.with_name(f"{target.name}.kept-{number}")
        target.rename(aside)
        return aside.name

    def unused(self, keep: Iterable[Origin], stages: Iterable[str]) -> list[Path]:
        """Every result of the stages but those in `keep`, and all that dead runs left behind."""
        kept = {path for origin in keep for path in (self.folder(origin), self._scratch(origin))}
        return [path for path in leftovers.ours_in(self.root, stages) if path not in kept]

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes out. The system frees the lock if this process dies.

        Raises:
            WorkspaceBusy: another process holds it.
            WriteError: the workspace cannot be written.
        """
        if self._is_locked:  # by our caller
            yield
            return
        with locked(self.root):
            self._is_locked = True
            try:
                yield
            finally:
                self._is_locked = False

    def _scratch(self, origin: Origin) -> Path:
        return self.folder(origin).with_name(f".scratch-{origin.key}")


def load(kind: type[T], folder: Path) -> T:
    """Read an artifact. However its files were made, what cannot be read is damaged.

    Raises:
        CorruptError: it is damaged.
        OutOfMemory, DiskFault: the machine fails.
    """
    try:
        return kind.load(folder)
    except RefdgsError:
        raise
    except Exception as error:
        raise_if_machine(error)
        words = printable(f"{type(error).__name__}: {error}")
        raise CorruptError(f"{folder}: cannot be read ({words})") from error


def _holds_only(target: Path, there: Iterable[str], known: Mapping[str, str]) -> bool:
    """Whether the named files are all known by their content, and none is a link."""
    return all(
        not _is_odd(target / name)
        and hash_file(target / name, like=known.get(name, "")) == known.get(name)
        for name in there
    )


def _is_odd(path: Path) -> bool:
    return path.is_symlink() or not path.is_file()


def _times(folder: Path, manifest: Manifest) -> list[object]:
    """What changes when a file of a result does; nothing if one cannot be looked at."""
    try:
        found: list[stat_result] = [(folder / name).lstat() for name in manifest.files]
    except OSError:
        return []
    times = [(f.st_ino, f.st_size, f.st_mtime_ns, f.st_ctime_ns) for f in found]
    return [*times, *visible(folder)]
