"""Content hashes, and the memory that saves hashing unchanged photos again."""

import hashlib
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from refdgs_pipe.documents import parse_json, read_text
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.formatting import printable
from refdgs_pipe.pipeline.atomic import write_json
from refdgs_pipe.trouble import raise_if_machine

# A file changed this shortly before it was hashed may change again without its times showing it.
TOO_NEW_NS = 2_000_000_000
OLDER = 32  # hex digits of the hashes that older workspaces hold


@dataclass(frozen=True)
class Fingerprint:
    """What a source holds: one hash over it all, and one for each file."""

    digest: str
    files: dict[str, str]


def hasher(like: str = "") -> "hashlib.blake2b":
    """What computes a hash: BLAKE2b, 256 bits; 128 bits if it is compared with a hash of those.

    Args:
        like: the hash that it is compared with, if there is one.
    """
    return hashlib.blake2b(digest_size=16 if len(like) == OLDER else 32)


def hash_file(path: Path, like: str = "") -> str:
    """Hash a file's bytes; `like` as in `hasher`."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hasher(like)).hexdigest()


def hash_path(path: Path) -> str:
    """Hash a file's bytes, or the names and bytes of all files right in a folder."""
    if not path.is_dir():
        return hash_file(path)
    return combine({file.name: hash_file(file) for file in path.iterdir() if file.is_file()})


def combine(files: Mapping[str, str]) -> str:
    """One hash of names and their contents' hashes, whatever their order.

    It has 128 bits if all of those have, so that the keys of older results stay the same.
    """
    text = "".join(f"{name} {content}\n" for name, content in sorted(files.items()))
    out = hasher(max(files.values(), key=len, default=""))
    out.update(text.encode("utf-8", "surrogateescape"))
    return out.hexdigest()


def fingerprint(
    files: Iterable[tuple[str, Path]], memory: Path, last: Mapping[str, str] | None = None
) -> Fingerprint:
    """Hash the named files of a source. What has unchanged size and times is known by `memory`.

    Args:
        last: name -> hash when they were last used: files are compared with hashes as long as that.

    Raises:
        CaptureError: a file cannot be read.
    """
    known = _read_memory(memory)
    start = time.time_ns()
    hashes: dict[str, str] = {}
    fresh: dict[str, list[int | str]] = {}
    for name, path in files:
        while name in hashes:  # files of one name from several folders
            name += "+"
        try:
            stat = path.stat()
            facts = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]
            old = known.get(name, [])
            before = str(old[3]) if old else (last or {}).get(name, "")
            hashes[name] = before if old[:3] == facts else hash_file(path, like=before)
        except OSError as error:
            raise_if_machine(error)
            raise CaptureError(f"{printable(path)}: cannot be read ({error.strerror})") from None
        if max(facts[1:]) < start - TOO_NEW_NS:
            fresh[name] = [*facts, hashes[name]]
    if fresh != known:
        with suppress(OSError):  # a workspace that cannot be written can still be looked at
            write_json(memory, {"files": fresh})
    return Fingerprint(combine(hashes), hashes)


def _read_memory(memory: Path) -> dict[str, list[int | str]]:
    """What is known of files: size, two times and hash of each. The rest is left out."""
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        files = parse_json(read_text(memory, follow=False))["files"]
        return {name: facts for name, facts in files.items() if _is_known(facts)}
    return {}


def _is_known(facts: object) -> bool:
    return isinstance(facts, list) and len(facts) == 4 and isinstance(facts[3], str)
