"""Keep shared results sound and small: compare every byte, delete what is old."""

import secrets
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

from refdgs_pipe.errors import CorruptError
from refdgs_pipe.formatting import printable
from refdgs_pipe.sharing.objects import BYTES, RECORDS, Objects, bytes_path, store_errors

GRACE = timedelta(days=1)  # files without a record may belong to a result that is being shared
_THREADS = 16
_AT_ONCE = 1000  # deletions in one request


@dataclass
class Verified:
    """What `verify` found.

    Args:
        bad: path -> what is wrong with it.
    """

    records: int = 0
    files: int = 0
    bytes: int = 0
    bad: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Collected:
    """What `collect` deleted, or would delete."""

    records: int
    files: int
    bytes: int


def verify(objects: Objects, *, delete: bool = False) -> Verified:
    """Compare every record and every file with its hash.

    Args:
        delete: delete bad records, and bad files with the records that need them.

    Raises:
        DiskFault: the store cannot be used.
    """
    found = Verified()
    wanted: dict[str, tuple[str, int]] = {}  # path of bytes -> digest, size
    users: dict[str, list[str]] = {}
    for path, manifest in _records(objects, (meta["path"] for meta in _list(objects, RECORDS))):
        found.records += 1
        if isinstance(manifest, CorruptError):
            found.bad[path] = str(manifest)
            continue
        for size, digest in manifest.files.values():
            wanted[bytes_path(digest)] = (digest, size)
            users.setdefault(bytes_path(digest), []).append(path)

    def compare(entry: tuple[str, tuple[str, int]]) -> tuple[str, int, str]:
        path, (digest, size) = entry
        try:
            return path, sum(len(part) for part in objects.bytes_of(digest, size)), ""
        except CorruptError as error:
            return path, 0, str(error)

    with ThreadPoolExecutor(_THREADS) as pool:
        for path, size, words in pool.map(compare, wanted.items()):
            found.files, found.bytes = found.files + 1, found.bytes + size
            if words:
                found.bad[path] = words
    if delete:
        gone = {user for path in found.bad for user in users.get(path, [])}
        _delete(objects, {*gone, *found.bad})
    return found


def collect(
    objects: Objects, older_than: timedelta, keep: Callable[[str], bool], *, dry_run: bool = False
) -> Collected:
    """Delete records that were shared long ago, then files that no record needs.

    Ages are told by the store's own clock.

    Args:
        keep: whether STAGE/KEY stays, however old.

    Raises:
        DiskFault: the store cannot be used.
    """
    now = _now(objects)
    stays: list[str] = []
    goes: list[str] = []
    for meta in _list(objects, RECORDS):
        name = meta["path"].removeprefix(f"{RECORDS}/").removesuffix(".json")
        old = now - meta["last_modified"] >= older_than and not keep(name)
        (goes if old else stays).append(meta["path"])
    files = {m["path"]: m for m in _list(objects, BYTES) if now - m["last_modified"] > GRACE}
    known = {*stays, *goes}
    new = [m["path"] for m in _list(objects, RECORDS) if m["path"] not in known]
    for _, manifest in _records(objects, [*stays, *new]):
        if not isinstance(manifest, CorruptError):
            for _, digest in manifest.files.values():
                files.pop(bytes_path(digest), None)
    if not dry_run:
        _delete(objects, {*goes, *files})
    return Collected(len(goes), len(files), sum(meta["size"] for meta in files.values()))


def _records(objects: Objects, paths: Iterable[str]) -> Iterator[tuple[str, Any]]:
    """Each path with its record, or with the error that it gave; those that are gone left out."""

    def read(path: str) -> tuple[str, Any]:
        try:
            return path, objects.record(path)
        except CorruptError as error:
            return path, error

    with ThreadPoolExecutor(_THREADS) as pool:
        for path, manifest in pool.map(read, paths):
            if manifest is not None:
                yield path, manifest


def _list(objects: Objects, prefix: str) -> Iterator[Any]:
    with store_errors(objects.place):
        for page in objects.store.list(prefix, chunk_size=_AT_ONCE):
            yield from page


def _now(objects: Objects) -> datetime:
    """The time by the store's clock."""
    path = f"clock-{secrets.token_hex(8)}"
    with store_errors(objects.place):
        objects.store.put(path, b"")
        try:
            now: datetime = objects.store.head(path)["last_modified"]
        finally:
            objects.store.delete(path)
    return now


def _delete(objects: Objects, paths: set[str]) -> None:
    """Delete records, then bytes, so that no record is ever without its files."""
    for prefix in (RECORDS, BYTES):
        there = sorted(path for path in paths if path.startswith(f"{prefix}/"))
        for start in range(0, len(there), _AT_ONCE):
            some = there[start : start + _AT_ONCE]
            with store_errors(objects.place):
                try:
                    objects.store.delete(some)
                except FileNotFoundError:  # somebody else deleted one of them
                    for path in some:
                        with suppress(FileNotFoundError):
                            objects.store.delete(path)


def described(found: Verified) -> list[str]:
    """In words, a line for each bad path."""
    return [printable(words) for _, words in sorted(found.bad.items())]
