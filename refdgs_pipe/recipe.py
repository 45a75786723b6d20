"""Recipes: named sets of differences from the defaults that stand in the code.

A recipe is a TOML file. It opens with a comment that says when to use it, may build on another one
(`extends = "glossy"`), may say that it is for a first look (`draft = true`), and has a table for
each stage that it changes.
"""

import difflib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from refdgs_pipe.documents import MAX_TOML, parse_toml, read_text
from refdgs_pipe.errors import InputError
from refdgs_pipe.formatting import printable
from refdgs_pipe.names import fault_of, leads_out
from refdgs_pipe.params import Params
from refdgs_pipe.trouble import raise_if_machine

DEFAULT = "glossy"
BASICS = (
    "ingest.max_side",
    "start.max_side",
    "start.ground",
    "train.iterations",
    "train.max_surfels",
    "train.reflection",
    "clean.keep",
    "clean.faces",
    "bake.size",
    "export.longest",
)  # the settings that users change most


@dataclass(frozen=True)
class Recipe:
    """A recipe as written, with those it extends merged in.

    Args:
        about: its opening comment.
        tables: stage -> setting -> value, as TOML has them.
        origins: "stage.setting" -> the file that said so.
        draft: it is meant for a first look (`draft = true`); one that extends it is so too, unless
            it says otherwise.
    """

    name: str
    about: str
    tables: dict[str, dict[str, Any]]
    origins: dict[str, str]
    draft: bool = False


def names() -> list[str]:
    """The recipes that come with the product, the default first."""
    folder = files("refdgs_pipe.recipes")
    found = [Path(file.name) for file in folder.iterdir()]
    stems = sorted(path.stem for path in found if path.suffix == ".toml")
    return sorted(stems, key=lambda name: name != DEFAULT)


def load(name: str) -> Recipe:
    """Read a recipe by name, or from a TOML file of the user's.

    Raises:
        InputError: there is no such recipe, it is not TOML, or it extends itself.
    """
    return _load(name, Path(), seen=())


def resolve(
    recipe: Recipe,
    assignments: Iterable[str],
    models: Mapping[str, type[Params]],
    *,
    tell: Callable[[str], None] = lambda _: None,
) -> dict[str, Params]:
    """The settings of every stage: defaults, then the recipe, then the `stage.key=value` given.

    Args:
        tell: hears of settings that have another name now, or are none any more and are left out.

    Raises:
        InputError: a stage or setting is unknown, or a value is not allowed.
    """
    tables = {stage: dict(table) for stage, table in recipe.tables.items()}
    origins = dict(recipe.origins)
    for name in [f"{stage}.{key}" for stage, table in tables.items() for key in table]:
        if (today := _today(name, models)) != name:
            said = origins[today] = origins.pop(name, recipe.name)
            tell(f"{said}: {name} is now {today}")
            stage, key = name.split(".")
            _merge(tables, {today.split(".")[0]: {today.split(".")[1]: tables[stage].pop(key)}})
    for text in assignments:
        stage, key, value = _parse_assignment(text)
        if (today := _today(f"{stage}.{key}", models)) != f"{stage}.{key}":
            tell(f"--set {text}: {stage}.{key} is now {today}")
            stage, _, key = today.partition(".")
        _merge(tables, {stage: _nested(key, value)})
        origins[f"{stage}.{key}"] = f"--set {text}"
    for stage, table in tables.items():
        where = next((o for key, o in origins.items() if key.startswith(f"{stage}.")), recipe.name)
        if stage not in models:
            raise InputError(f"{where}: no stage is called {stage!r}{_nearest(stage, models)}")
        for key in list(table):
            said = origins.get(f"{stage}.{key}", where)
            if former := models[stage].former.get(key):
                tell(f"{said}: {stage}.{key} is now {former.instead}, and is ignored here")
                del table[key]
            elif key not in models[stage].model_fields:
                hint = _nearest(key, models[stage].model_fields, f"{stage}.")
                raise InputError(f"{said}: {stage} has no setting {key!r}{hint}")
    return {stage: _validate(stage, model, tables, origins) for stage, model in models.items()}


def assignment(name: str, value: Any) -> str:
    """The `stage.key=value` that says this.

    Raises:
        InputError: the value is None, which no setting is set to.
    """
    text = _toml(value)
    if text is None:
        raise InputError(f"{name} = None: leave it out, and it has its default")
    return f"{name}={text}"


def up_to_date(assignments: Iterable[str], models: Mapping[str, type[Params]]) -> tuple[str, ...]:
    """The `stage.key=value` with the names of today, without those that are no settings any more.

    Raises:
        InputError: one is no assignment.
    """
    found = []
    for text in assignments:
        stage, key, _ = _parse_assignment(text)
        if stage in models and key in models[stage].former:
            continue
        _, equals, value = text.partition("=")
        today = _today(f"{stage}.{key}", models)
        found.append(text if today == f"{stage}.{key}" else f"{today}{equals}{value}")
    return tuple(found)


def basics(settings: Mapping[str, Params]) -> str:
    """The settings that users change most, as comments: `stage.setting = value` and its meaning."""
    found = []
    for name in BASICS:
        stage, _, key = name.partition(".")
        params = settings[stage]
        value = _toml(getattr(params, key)) or "unset"
        found.append((f"{name} = {value}", type(params).model_fields[key].description))
    width = max(len(text) for text, _ in found)
    return "".join(f"# {text:{width}}  {about}\n" for text, about in found)


def describe(settings: Mapping[str, Params], *, only: Recipe | None = None) -> str:
    """Settings as TOML by stage and group, each with its meaning; `only` those of a recipe."""
    models = {stage: type(params) for stage, params in settings.items()}
    written = {stage: model.model_fields.keys() for stage, model in models.items()}
    names = {
        _today(f"{stage}.{key}", models)
        for stage, keys in (only.tables if only else written).items()
        for key in keys
    }
    lines: list[str] = []
    for stage, params in settings.items():
        mentioned = {name.partition(".")[2] for name in names if name.startswith(f"{stage}.")}
        if not mentioned:
            continue
        lines += ["", f"[{stage}]"]
        for heading, keys in type(params).groups().items():
            shown = [key for key in keys if key in mentioned]
            lines += ["", f"# --- {heading} ---"] if heading and shown else []
            for key in shown:
                value = getattr(params, key)
                text = _toml(value.model_dump() if isinstance(value, Params) else value)
                lines.append(f"# {meaning(type(params).model_fields[key])}")
                lines.append(f"# {key} =" if text is None else f"{key} = {text}")
    return "\n".join(lines).strip() + "\n"


def as_toml(recipe: Recipe) -> str:
    """A recipe with all that it builds on, as one TOML file that says the same."""
    lines = [f"# {recipe.about}"] if recipe.about else []
    lines.append(f"draft = {_toml(recipe.draft)}")
    for stage, table in recipe.tables.items():
        lines += ["", f"[{stage}]", *(f"{key} = {_toml(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def meaning(info: FieldInfo) -> str:
    """A setting's description with its limits and default."""
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    limits = [
        f"{word} {getattr(rule, limit):g}"
        for rule in info.metadata
        for limit, word in words.items()
        if hasattr(rule, limit)
    ]
    default = "unset" if info.default is None else _toml(info.default)
    return f"{info.description} ({', '.join([*limits, f'default {default}'])})"


def _load(name: str, beside: Path, seen: tuple[str, ...]) -> Recipe:
    text, label = _read(name, beside)
    if label in seen:
        raise InputError(f"{label}: extends itself, by way of {' -> '.join(seen)}")
    try:
        tables = parse_toml(text)
    except ValueError as error:
        raise InputError(f"{label}: not TOML: {error}") from None
    parent = tables.pop("extends", None)
    if parent is not None and not isinstance(parent, str):
        raise InputError(f"{label}: extends = {parent!r}: expected the name of a recipe")
    draft = tables.pop("draft", None)
    if draft is not None and not isinstance(draft, bool):
        raise InputError(f"{label}: draft = {draft!r}: expected true or false")
    for stage, table in tables.items():
        if not isinstance(table, dict):
            raise InputError(f"{label}: {stage} stands outside a table. Put it under a [stage]")
    merged: dict[str, dict[str, Any]] = {}
    origins: dict[str, str] = {}
    if parent is not None:
        folder = Path(name).parent if name.endswith(".toml") else Path()
        _check_parent(parent, beside / folder, label)
        base = _load(parent, beside / folder, (*seen, label))
        merged, origins = base.tables, base.origins
        draft = base.draft if draft is None else draft
    _merge(merged, tables)
    origins |= {f"{stage}.{key}": label for stage, table in tables.items() for key in table}
    return Recipe(name, _opening_comment(text), merged, origins, bool(draft))


def _check_parent(name: str, folder: Path, label: str) -> None:
    """A recipe extends one of ours, or a file in its own folder: both may be passed on."""
    is_file = name.endswith(".toml") or "/" in name
    fault = fault_of(name)
    if not fault and is_file and leads_out(folder, folder / name):
        fault = "it is a link out of the folder"
    if fault:
        raise InputError(
            f"{label}: extends = {printable(name)!r}: {fault}. Give the name of a recipe, or of a "
            "file in the same folder"
        )


def _read(name: str, beside: Path) -> tuple[str, str]:
    """The text of a recipe and how to call it in messages."""
    if name.endswith(".toml") or "/" in name:
        path = beside / name
        try:
            return read_text(path, limit=MAX_TOML), str(path)
        except (OSError, ValueError) as error:
            raise_if_machine(error)
            raise InputError(f"{path}: cannot read this recipe ({error})") from None
    if name not in names():
        hint = _nearest(name, names())
        raise InputError(
            f"no recipe is called {name!r}{hint} There are: {' '.join(names())}, or a .toml file"
        )
    text = (files("refdgs_pipe.recipes") / f"{name}.toml").read_text("utf-8")
    return text, f"recipe {name}"


def _opening_comment(text: str) -> str:
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# ").rstrip())
    return " ".join(lines)


def _parse_assignment(text: str) -> tuple[str, str, Any]:
    path, equals, raw = text.partition("=")
    stage, dot, key = path.strip().partition(".")
    if not (equals and dot and stage and key):
        raise InputError(f"--set {text}: expected stage.setting=value, as in extract.voxel=0.002")
    try:
        return stage, key, parse_toml(f"value = {raw}")["value"]
    except ValueError:
        return stage, key, raw.strip()  # a word needs no quotes on the command line


def _today(name: str, models: Mapping[str, type[Params]]) -> str:
    """What a "stage.setting" is called now."""
    stage, _, key = name.partition(".")
    return models[stage].renamed.get(key, name) if stage in models else name


def _nested(key: str, value: Any) -> dict[str, Any]:
    """{"a": {"b": value}} for the key "a.b"."""
    for part in reversed(key.split(".")):
        value = {part: value}
    assert isinstance(value, dict)
    return value


def _merge(into: dict[str, Any], more: Mapping[str, Any]) -> None:
    for key, value in more.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            into[key] = dict(into[key])
            _merge(into[key], value)
        else:
            into[key] = value


def _validate(
    stage: str,
    model: type[Params],
    tables: Mapping[str, Mapping[str, Any]],
    origins: Mapping[str, str],
) -> Params:
    try:
        return model.model_validate(tables.get(stage, {}))
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(str(part) for part in problem["loc"])
        whole = str(problem["loc"][0]) if problem["loc"] else ""  # of which this may be an item
        info = model.model_fields.get(whole)
        origin = origins.get(f"{stage}.{key}", origins.get(f"{stage}.{whole}", "recipe"))
        reason = problem["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
        about = f". {key}: {meaning(info)}" if info else ""
        shown = _toml(problem["input"]) or "unset"
        raise InputError(f"{origin}: {stage}.{key} = {shown}: expected {reason}{about}") from None


def _nearest(name: str, known: Iterable[str], prefix: str = "") -> str:
    """A question with the closest known name, or the end of the sentence."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f". Did you mean {prefix}{close[0]}?" if close else "."


def _toml(value: Any) -> str | None:
    """A value as TOML writes it; None has no TOML."""
    if value is None:
        return None
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        items = ((key, _toml(item)) for key, item in value.items())
        return "{ " + ", ".join(f"{key} = {item}" for key, item in items if item) + " }"
    if isinstance(value, Sequence):
        return "[" + ", ".join(_toml(item) or "" for item in value) + "]"
    return str(value)
