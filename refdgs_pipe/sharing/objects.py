"""Results in an object store: `ac/STAGE/KEY.json` is a record, `cas/AA/DIGEST` a file's bytes.

A file's bytes go first, the record goes last and only if there is none: whoever finds a record
finds its files. Nothing that is read is believed before it was compared with its hash.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from refdgs_pipe.documents import write_json_text
from refdgs_pipe.errors import CorruptError, DiskFault
from refdgs_pipe.formatting import printable
from refdgs_pipe.pipeline.fingerprint import hasher
from refdgs_pipe.pipeline.manifest import LIMIT, MANIFEST, Manifest, Origin

RECORDS, BYTES = "ac", "cas"
ATTEMPTS = 3  # at a file whose bytes stop in the middle
_CHUNK = 4 << 20
_HASH = re.compile(r"(?:[0-9a-f]{32}){1,2}")  # of 128 bits, in records of older versions, or 256


@dataclass
class Objects:
    """Shared results in a store of obstore's.

    Args:
        place: how people call it, for messages.
        requests: kind -> how many were made; a file in parts counts once.
    """

    store: Any
    place: str
    requests: dict[str, int] = field(default_factory=dict)
    _bad: set[str] = field(default_factory=set)  # paths that were found not to be what they should

    def find(self, origin: Origin) -> Manifest | None:
        """As `Shared.find`."""
        return self.record(record_path(origin.stage, origin.key))

    def record(self, path: str) -> Manifest | None:
        """The record at `ac/STAGE/KEY.json`; None if there is none.

        Raises:
            CorruptError: it is damaged, or that of another result; the words name it.
            DiskFault: the store cannot be used.
        """
        where = f"{self.place}/{path}"
        with self._troubles():
            try:
                found = self._call("get", path)
                if found.meta["size"] > LIMIT:
                    raise CorruptError(f"{where}: {found.meta['size']} bytes are no record")
                data = bytes(found.bytes())
            except FileNotFoundError:
                return None
        folder = Path(PurePosixPath(path).relative_to(RECORDS).with_suffix(""))
        try:
            text = data.decode("utf-8")
            manifest = Manifest.parse(text, folder, where=where, strict=True)
            _check_names(manifest, where)
        except (UnicodeDecodeError, CorruptError) as error:
            self._bad.add(path)
            words = f"{where}: not UTF-8" if isinstance(error, UnicodeDecodeError) else str(error)
            raise CorruptError(words) from None
        return manifest

    def bring(self, manifest: Manifest, folder: Path) -> None:
        """As `Shared.bring`."""
        try:
            for name, (size, digest) in manifest.files.items():
                path = folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                self._download(digest, size, path)
        except CorruptError:
            self._bad.add(record_path(manifest.origin.stage, manifest.origin.key))
            raise

    def _download(self, digest: str, size: int, path: Path) -> None:
        for attempt in range(ATTEMPTS):
            try:
                with path.open("wb") as file:
                    for part in self.bytes_of(digest, size):
                        file.write(part)
                return
            except DiskFault:
                if attempt + 1 == ATTEMPTS:
                    raise

    def bytes_of(self, digest: str, size: int) -> Iterator[bytes]:
        """The bytes with this hash, in parts. They may be used only once all of them came.

        Raises:
            CorruptError: they are missing, or others; the words name them.
            DiskFault: the store cannot be used, or the bytes stop in the middle.
        """
        path = bytes_path(digest)
        where, seen, read = f"{self.place}/{path}", 0, hasher(digest)
        with self._troubles():
            try:
                found = self._call("get", path)
            except FileNotFoundError:
                raise CorruptError(f"{where}: missing") from None
            if found.meta["size"] != size:
                self._bad.add(path)
                raise CorruptError(f"{where}: {found.meta['size']} bytes, {size} expected")
            for part in found.stream(_CHUNK):
                data = bytes(part)
                seen += len(data)
                read.update(data)
                yield data
        if seen != size:
            raise DiskFault(f"{where}: {seen} of {size} bytes came")
        if read.hexdigest() != digest:
            self._bad.add(path)
            raise CorruptError(f"{where}: its content is not what its name says")

    def offer(self, manifest: Manifest, folder: Callable[[], Path]) -> None:
        """As `Shared.offer`. What was found to be bad is written over, all else never."""
        path = record_path(manifest.origin.stage, manifest.origin.key)
        with self._troubles():
            if path not in self._bad and self._size(path) is not None:
                return
            place = folder()
            for name, (size, digest) in manifest.files.items():
                blob = bytes_path(digest)
                if blob in self._bad or self._size(blob) != size:
                    self._call("put", blob, place / name)
                    self._bad.discard(blob)
            text = write_json_text(manifest.record()) + "\n"
            mode = "overwrite" if path in self._bad else "create"
            with suppress(_exists()):  # another machine was first: its result counts
                self._call("put", path, text.encode("utf-8", "surrogatepass"), mode=mode)
            self._bad.discard(path)

    def _size(self, path: str) -> int | None:
        try:
            return int(self._call("head", path)["size"])
        except FileNotFoundError:
            return None

    def _call(self, name: str, *values: Any, **options: Any) -> Any:
        self.requests[name] = self.requests.get(name, 0) + 1
        return getattr(self.store, name)(*values, **options)

    @contextmanager
    def _troubles(self) -> Iterator[None]:
        """Say in words that the store fails, whatever the kind of store."""
        with store_errors(self.place):
            yield


@contextmanager
def store_errors(place: str) -> Iterator[None]:
    """Turn a failure of a store into words.

    Raises:
        DiskFault: it cannot be reached, refuses, or stops in the middle.
    """
    from obstore.exceptions import BaseError

    try:
        yield
    except BaseError as error:
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise DiskFault(
            f"{place}: the shared results cannot be used ({printable(first)})"
        ) from None


def record_path(stage: str, key: str) -> str:
    """Where the record of a result is."""
    return f"{RECORDS}/{stage}/{key}.json"


def bytes_path(digest: str) -> str:
    """Where the bytes with this hash are."""
    return f"{BYTES}/{digest[:2]}/{digest}"


def _exists() -> type[Exception]:
    from obstore.exceptions import AlreadyExistsError

    found: type[Exception] = AlreadyExistsError
    return found


def _check_names(manifest: Manifest, where: str) -> None:
    """Refuse names that could hide one another, and hashes that are none.

    Raises:
        CorruptError: there are some.
    """
    paths = {PurePosixPath(name) for name in manifest.files}
    folders = {parent for path in paths for parent in path.parents}
    if PurePosixPath(MANIFEST) in paths or paths & folders or len(paths) < len(manifest.files):
        raise CorruptError(f"{where}: names of files that exclude one another")
    for size, digest in manifest.files.values():
        if size < 0 or not _HASH.fullmatch(digest):
            raise CorruptError(f"{where}: {printable(digest)[:40]} is no hash")
