"""`refdgs-pipe verify`: every file of a workspace against its record, from photos to the asset."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.errors import CaptureError, CorruptError, InputError
from refdgs_pipe.formatting import printable
from refdgs_pipe.pipeline.catalog import PUBLISHED
from refdgs_pipe.pipeline.fingerprint import Fingerprint
from refdgs_pipe.pipeline.leftovers import results_in
from refdgs_pipe.pipeline.manifest import Manifest, check_contents
from refdgs_pipe.pipeline.plan import Step

_SHOWN = 10  # photos that are listed on a terminal; --json has all


@dataclass(frozen=True)
class Link:
    """One stage of the chain.

    Args:
        inputs: argument -> digest that the result was made from.
        from_stage: argument -> the stage that made it; the photos have none.
        files: name -> hash.
    """

    stage: str
    key: str
    digest: str
    inputs: dict[str, str]
    from_stage: dict[str, str]
    files: dict[str, str]


@dataclass(frozen=True)
class Proof:
    """What came of it.

    Args:
        photos: the photos' files as they are now; of the last run, if they are gone.
        photos_note: what is wrong with them, or "".
        links: the chain of current results, in order.
        checked: the number of results whose every byte was compared.
        damaged: result -> what was wrong; each was set aside as `.damaged-KEY`.
        open: stages that are not up to date -> why: the chain is broken there.
        asset: what is wrong with the published folder, or "".
        asset_files: name -> hash of what it holds.
    """

    photos: Fingerprint
    photos_note: str
    links: tuple[Link, ...]
    checked: int
    damaged: dict[str, str]
    open: dict[str, str]
    asset: str
    asset_files: dict[str, str]

    @property
    def exit_code(self) -> int:
        """0 if every byte is as it was written, else that of damaged files."""
        is_sound = not (self.damaged or self.asset)
        return 0 if is_sound else CorruptError.exit_code

    def record(self) -> dict[str, Any]:
        """For programs."""
        return {
            "sound": self.exit_code == 0,
            "complete": not self.open,
            "photos": self.photos.files,
            "capture": self.photos.digest,
            "photos_note": self.photos_note,
            "chain": [vars(link) for link in self.links],
            "checked": self.checked,
            "damaged": self.damaged,
            "open": self.open,
            "asset": self.asset,
            "asset_files": self.asset_files,
        }


def examine(space: Workspace) -> Proof:
    """Compare every file with its record. What differs is set aside, for the next run to make.

    Raises:
        WorkspaceBusy: another process works in the workspace.
        WriteError: what is damaged cannot be set aside.
    """
    store, pipeline = space.pipeline.store, space.pipeline
    with store.lock():
        store.sweep(pipeline.names)
        damaged, checked = dict[str, str](), 0
        for folder, error in _results(space):
            checked += 1
            if error is not None:
                store.put_aside(folder)
                damaged[f"{folder.parent.name}/{folder.name}"] = str(error)
        photos, photos_note = _photos(space)
        steps = space.status()
        asset, asset_files = _published(space, steps)
    links = tuple(_link(space, step) for step in steps if step.manifest is not None)
    undone = {step.stage.name: step.reason for step in steps if step.manifest is None}
    return Proof(photos, photos_note, links, checked, damaged, undone, asset, asset_files)


def make_sound(space: Workspace, *, tell: Callable[[str], None]) -> None:
    """`examine` before a run: what differs is set aside, and then made again."""
    if not space.root.is_dir():
        return
    found = examine(space)
    for name, words in found.damaged.items():
        tell(f"{name}: {words}. Set aside")
    tell(f"{found.checked} results compared byte for byte, {len(found.damaged)} damaged")


def describe(found: Proof) -> str:
    """The proof as plain text: photos, stages, asset, and what it comes to."""
    files = found.photos.files
    lines = [f"photos     {found.photos.digest}  {len(files)} files"]
    shown = list(files.items())[:_SHOWN]
    lines += [f"  {content}  {printable(name)}" for name, content in shown]
    if len(files) > _SHOWN:
        lines.append(f"  and {len(files) - _SHOWN} more (--json has all)")
    if found.photos_note:
        lines.append(f"  {printable(found.photos_note)}")
    for link in found.links:
        made_from = ", ".join(
            f"{name} {digest[:12]} of {link.from_stage.get(name, 'the photos')}"
            for name, digest in link.inputs.items()
        )
        lines.append(f"{link.stage:10} {link.digest}  {len(link.files)} files, from {made_from}")
    for name, content in found.asset_files.items():
        lines.append(f"asset      {content}  {printable(name)}")
    lines += [f"open       {stage}: {printable(reason)}" for stage, reason in found.open.items()]
    lines += [f"DAMAGED    {printable(words)}: set aside" for words in found.damaged.values()]
    if found.asset:
        lines.append(f"DAMAGED    {printable(found.asset)}")
    verdict = "every byte is as it was written"
    if found.exit_code:
        verdict = "not as it was written. `run` makes it again"
    return "\n".join([*lines, f"{found.checked} results compared: {verdict}"])


def _results(space: Workspace) -> Iterator[tuple[Path, CorruptError | None]]:
    """Every result in the workspace, the current ones and older ones, with what is wrong."""
    for folder in list(results_in(space.root, space.pipeline.names)):
        try:
            check_contents(folder, Manifest.read(folder))
            yield folder, None
        except CorruptError as error:
            yield folder, error


def _photos(space: Workspace) -> tuple[Fingerprint, str]:
    """The photos as they are, every byte read anew, and what is wrong with them."""
    space.pipeline.forget_source()
    try:
        return space.pipeline.fingerprint(space.source), ""
    except (CaptureError, InputError) as error:
        last = space.pipeline.last_fingerprint() or Fingerprint("", {})
        return last, f"the photos are not there, these are the last run's hashes: {error}"


def _published(space: Workspace, steps: list[Step]) -> tuple[str, dict[str, str]]:
    """What is wrong with the published folder, and the hashes of its files."""
    for step in steps:
        name = PUBLISHED.get(step.stage.name)
        if name is None or step.manifest is None:
            continue
        folder = space.root / name
        try:
            check_contents(folder, step.manifest)
        except CorruptError as error:
            return f"{error}. The next run writes {name}/ again", {}
        return "", {file: content for file, (_, content) in step.manifest.files.items()}
    return "", {}


def _link(space: Workspace, step: Step) -> Link:
    assert step.manifest is not None
    makers = space.pipeline.makers
    return Link(
        step.stage.name,
        step.manifest.origin.key,
        step.manifest.digest,
        dict(step.manifest.origin.inputs),
        {n: makers[kind].name for n, kind in step.stage.inputs.items() if kind in makers},
        {name: content for name, (_, content) in step.manifest.files.items()},
    )
