"""Names of files that come out of files: they must stay below the folder that they belong to."""

from pathlib import Path, PurePosixPath


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
    return None


def link_in(folder: Path, name: str) -> str | None:
    """The first part of a name below a folder that is a link there; None if none is.

    Raises:
        OSError: a part cannot be looked at, other than because it is missing.
    """
    place = folder
    for part in PurePosixPath(name).parts:
        place = place / part
        if place.is_symlink():
            return place.relative_to(folder).as_posix()
    return None


def leads_out(folder: Path, path: Path) -> bool:
    """Whether a path, with every link in it followed, is not below a folder."""
    return not path.resolve().is_relative_to(folder.resolve())
