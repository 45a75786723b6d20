"""The record kept beside each result, and the check of a result against it."""

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Self

from refdgs_pipe.documents import parse_json, read_text
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.formatting import printable
from refdgs_pipe.names import fault_of
from refdgs_pipe.pipeline.fingerprint import combine, hash_file

MANIFEST = "manifest.json"
SCHEMA = 1  # raised when the layout of results changes
KEY = re.compile(r"[0-9a-f]{16}")
LIMIT = 64_000_000  # bytes of a manifest
MISSING = (FileNotFoundError, NotADirectoryError)


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
class Record:
    """What a stage said about its result while making it."""

    seconds: float
    source_files: dict[str, str]
    measures: tuple[tuple[str, float | int | str, str], ...] = ()
    warnings: tuple[str, ...] = ()
    note: str = ""


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
    def read(cls, folder: Path) -> Self:
        """Read the record of the result in `STAGE/KEY`.

        Nothing that it says is believed: it has a checksum of its own (records written before there
        was one have none), its origin must give the folder's key, its files' hashes the digest, and
        its names must stay in the folder.

        Raises:
            CorruptError: it is missing, damaged, or that of another result.
        """
        path = folder / MANIFEST
        try:
            if folder.is_symlink() or folder.parent.is_symlink():
                raise ValueError("its folder is a link. A workspace holds no links")
            text = read_text(path, limit=LIMIT, follow=False)
        except (ValueError, *MISSING) as error:
            raise CorruptError(f"{path}: not readable ({printable(error)})") from None
        return cls.parse(text, folder, where=str(path))

    @classmethod
    def parse(cls, text: str, folder: Path, *, where: str, strict: bool = False) -> Self:
        """The record that a text holds, checked as `read` does.

        Args:
            folder: STAGE/KEY, of which only the names are looked at.
            where: what an error names.
            strict: a record without a checksum is refused.

        Raises:
            CorruptError: it is damaged, or that of another result.
        """
        try:
            record = parse_json(text)
            if strict and "checksum" not in record:
                raise ValueError("it has no checksum")
            return cls._checked(record, folder)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise CorruptError(f"{where}: not readable ({printable(error)})") from None

    @classmethod
    def _checked(cls, record: dict[str, Any], folder: Path) -> Self:
        checksum = record.pop("checksum", None)
        if checksum is not None and checksum != _checksum(record):
            raise ValueError("it was changed since it was written")
        origin = Origin(**record.pop("origin"))
        if (origin.stage, origin.key) != (folder.parent.name, folder.name):
            raise ValueError(f"it is the record of {origin.stage}/{origin.key}")
        files = {str(name): (int(size), str(h)) for name, (size, h) in record.pop("files").items()}
        for name in files:
            if fault := fault_of(name):
                raise ValueError(f"{name}: {fault}")
        measures = tuple(
            (str(n), v if isinstance(v, float | int) else str(v), str(unit))
            for n, v, unit in record.pop("measures")
        )
        warnings = tuple(map(str, record.pop("warnings")))
        made = cls(origin, files=files, measures=measures, warnings=warnings, **record)
        if made.digest != digest_of(files):
            raise ValueError("its digest is not that of its files")
        float(made.seconds)
        if not all(isinstance(text, str) for text in (made.note, made.made_utc)):
            raise TypeError("note and made_utc must be texts")
        if not all(isinstance(text, str) for pair in made.source_files.items() for text in pair):
            raise TypeError("source_files must be texts")
        return made

    def record(self) -> dict[str, Any]:
        """The manifest as JSON has it, with its checksum."""
        record = json.loads(json.dumps(asdict(self)))
        return {**record, "checksum": _checksum(record)}


def digest_of(files: dict[str, tuple[int, str]]) -> str:
    """The hash of a result's content: of its files' names and hashes."""
    return combine({name: content for name, (_, content) in files.items()})


def check_sizes(folder: Path, manifest: Manifest) -> None:
    """Compare a result's files with its record by size.

    Raises:
        CorruptError: a file is missing, a link, or has another size.
    """
    for place in (folder, *_folders(folder, manifest)):
        if place.is_symlink():
            raise CorruptError(f"{place}: is a link. A workspace holds no links")
    for name, (size, _) in manifest.files.items():
        try:
            found = os.lstat(folder / name)
        except MISSING:
            raise CorruptError(f"{folder / name}: missing") from None
        if not stat.S_ISREG(found.st_mode):
            raise CorruptError(f"{folder / name}: is a link, or no regular file")
        if found.st_size != size:
            raise CorruptError(f"{folder / name}: {found.st_size} bytes, {size} expected")


def check_contents(folder: Path, manifest: Manifest) -> None:
    """Compare a result's files with its record byte for byte.

    Raises:
        CorruptError: a file is missing, differs, or does not belong there.
    """
    for _ in checking(folder, manifest):
        pass


def checking(folder: Path, manifest: Manifest) -> Iterator[str]:
    """`check_contents`, file by file: yields each name once it was found whole.

    Raises:
        CorruptError: as `check_contents`.
    """
    check_sizes(folder, manifest)
    strange = [name for name in visible(folder) if name not in {*manifest.files, MANIFEST}]
    if strange:
        raise CorruptError(f"{folder / strange[0]}: does not belong to the result")
    for name, (_, content) in manifest.files.items():
        if hash_file(folder / name, like=content) != content:
            raise CorruptError(f"{folder / name}: its content was changed since it was made")
        yield name


def visible(folder: Path) -> list[str]:
    """The names of all files below a folder that are not hidden, sorted; links are not followed."""
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        here = Path(place)
        linked = [name for name in folders if (here / name).is_symlink()]
        kept = [name for name in (*names, *linked) if not name.startswith(".")]
        found += [(here / name).relative_to(folder).as_posix() for name in kept]
    return sorted(found)


def _folders(folder: Path, manifest: Manifest) -> set[Path]:
    parents = {parent for name in manifest.files for parent in PurePosixPath(name).parents}
    return {folder / parent for parent in parents}


def _checksum(record: dict[str, Any]) -> str:
    """The hash of a record's content, however its JSON is laid out."""
    text = json.dumps(record, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=32).hexdigest()
