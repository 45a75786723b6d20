"""JSON and TOML that somebody else may have written: bounded in size, depth and time."""

import errno
import json
import os
import re
import stat
import tomllib
from pathlib import Path
from typing import Any

MAX_JSON = 256_000_000  # bytes
MAX_TOML = 200_000  # characters; a recipe with every setting has some 40 000
_UNSEEN = re.compile("[\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]")
_MAX_LINE = 10_000  # characters
# tomllib needs the square of the parts of a dotted key: at most so many marks in a line
_MAX_DOTS = 64
_MAX_OPEN = 1000  # brackets in all: deeper than this nothing is nested


def read_text(path: Path, *, limit: int = MAX_JSON, follow: bool = True) -> str:
    """A text file, if it is a regular file of at most `limit` bytes.

    Args:
        follow: whether the path itself may be a link.

    Raises:
        OSError: it cannot be read.
        ValueError: no regular file, a link that must be none, too large, or not UTF-8.
    """
    flags = os.O_RDONLY | os.O_NONBLOCK | (0 if follow else os.O_NOFOLLOW)
    try:
        handle = os.open(path, flags)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise ValueError("is a link, which is not followed") from None
        raise
    with os.fdopen(handle, "rb") as file:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise ValueError("not a regular file")
        if found.st_size > limit:
            raise ValueError(f"{found.st_size} bytes, at most {limit} are read")
        return file.read(limit + 1).decode("utf-8")


def parse_json(text: str) -> Any:
    """What a JSON text says.

    Raises:
        ValueError: it is none, or is nested too deep.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deep") from None


def write_json_text(record: Any, *, indent: int | None = 1) -> str:
    r"""JSON with its letters as they are; what no terminal should get, as \u codes that come back.

    Bytes that are no UTF-8, as Python has them in file names, stay \udcff.
    """
    text = json.dumps(record, indent=indent, ensure_ascii=False, default=str)
    return _UNSEEN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def parse_toml(text: str) -> dict[str, Any]:
    """What a TOML text says.

    Raises:
        ValueError: it is none, or so large or nested that reading it would take long.
    """
    if len(text) > MAX_TOML:
        raise ValueError(f"{len(text)} characters, at most {MAX_TOML} are read")
    for number, line in enumerate(text.splitlines(), start=1):
        if len(line) > _MAX_LINE or (line.count(".") > _MAX_DOTS and not _is_comment(line)):
            raise ValueError(f"line {number} is too long, or has too many dots")
    if text.count("[") + text.count("{") > _MAX_OPEN:
        raise ValueError(f"more than {_MAX_OPEN} brackets")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("nested too deep") from None


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")
