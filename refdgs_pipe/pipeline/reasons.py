"""Why a result has to be made, in words."""

from collections.abc import Collection, Mapping
from typing import Any

from refdgs_pipe.pipeline.store import Manifest, Origin


def why(
    origin: Origin,
    last: Manifest | None,
    *,
    makers: Mapping[str, str],
    source_files: Mapping[str, str],
    former: Collection[str] = (),
) -> str:
    """Say what differs between a wanted result and the one that the last run used.

    Args:
        makers: argument -> the stage that makes it; the source is not among them.
        source_files: name -> hash of the photos as they are now.
        former: names of settings that are none any more, and are not spoken of.
    """
    if last is None:
        return "never run"
    old = last.origin
    changes = _version_changes(origin, old)
    before, now = (
        _flat({name: value for name, value in params.items() if name not in former})
        for params in (old.params, origin.params)
    )
    changes += _differences(before, now)
    for name, digest in origin.inputs.items():
        if digest != old.inputs.get(name):
            maker = makers.get(name)
            changes.append(
                f"new {name} ({maker} changed)"
                if maker
                else _source_change(name, last.source_files, source_files)
            )
    if origin.adopted != old.adopted:
        changes.append("another adopted file" if origin.adopted else "adopted file set aside")
    return ", ".join(changes) or "its result is gone"


def _version_changes(origin: Origin, old: Origin) -> list[str]:
    changes = []
    if origin.schema != old.schema:
        changes.append(f"workspace format {old.schema} -> {origin.schema}")
    if origin.version != old.version:
        changes.append(f"stage version {old.version} -> {origin.version}")
    return changes + _differences(old.programs, origin.programs)


def _differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    changes = [
        f"{name} {_say(old[name])} -> {_say(value)}" if name in old else f"new setting {name}"
        for name, value in new.items()
        if name not in old or value != old[name]
    ]
    return changes + [f"setting {name} is gone" for name in old if name not in new]


def _flat(params: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested groups of settings as dotted names."""
    flat: dict[str, Any] = {}
    for name, value in params.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def _say(value: Any) -> str:
    if value is None:
        return "unset"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _source_change(name: str, old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """For example: new capture (2 of 48 files changed, 1 added)."""
    changed = sum(file in old and old[file] != content for file, content in new.items())
    counts = {
        f"{changed} of {len(new)} files changed": changed,
        f"{len(new.keys() - old.keys())} added": len(new.keys() - old.keys()),
        f"{len(old.keys() - new.keys())} removed": len(old.keys() - new.keys()),
    }
    return f"new {name} ({', '.join(text for text, count in counts.items() if count)})"
