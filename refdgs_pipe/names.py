"""Names of files that come out of files: they must stay below the folder that they belong to."""

import os
from pathlib import Path

_LONGEST = 240  # bytes; file systems take 255, and suffixes are added


def fault_of(name: object) -> str | None:
    """What is wrong with the name of a file below some folder; None if nothing is.

    A name is relative, with forward slashes, and has no part `..`. Backslashes and drive letters
    would lead elsewhere on other systems.
    """
    if not isinstance(name, str) or not name or name in (".", "./"):
        return "it is no file name"
    if "\0" in name:
        return "it has a NUL"
    plain = name.replace("\\", "/")
    if plain.startswith("/") or plain[1:3] == ":/":
        return "it is an absolute path"
    if ".." in plain.split("/"):
        return "it leads outside (..)"
    try:
        parts = [os.fsencode(part) for part in plain.split("/")]
    except UnicodeEncodeError:
        return "it is not text"
    if len(plain) > 1000 or any(len(part) > _LONGEST for part in parts):
        return "it is too long"
    return None


def leads_out(folder: Path, path: Path) -> bool:
    """Whether a path, with every link in it followed, is not below a folder."""
    return not path.resolve().is_relative_to(folder.resolve())
