"""Which pixels of the photos show the object, where the photos came without masks."""

import json
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np

from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.files.kinds import sniff
from refdgs_pipe.names import fault_of

Kind = Literal["given", "found", "network", "adopted", "none"]
_FILE = "masks.json"


@dataclass(frozen=True)
class Masks:
    """Masks of photos, by the views' names.

    Args:
        folder: holds NAME.png for each name: 8 bits, white is object, as large as the view's image.
        names: of the views that have one here; empty if `kind` is "given" or "none".
        kind: "given": the photos came with masks; "found": from the photos themselves; "network":
            by the user's network; "adopted": the user's, in place of those that were made;
            "none": there are none, for `reason`.
        reason: why there are none, in words; "" where there are.
    """

    folder: Path
    names: tuple[str, ...]
    kind: Kind
    reason: str = ""

    def path(self, name: str) -> Path:
        """The mask of a view."""
        return self.folder / f"{name}.png"

    def applied(self, views: Views, needed: Iterable[str]) -> Views:
        """The views with these masks; as they are where there are none.

        Args:
            needed: names of the views that have to have one.

        Raises:
            InputError: some of these have none.
        """
        if not self.names:
            return views
        missing = sorted(set(needed) - set(self.names))
        if missing:
            raise InputError(
                f"the masks have none for {', '.join(missing[:3])}"
                f"{' and others' if len(missing) > 3 else ''}: every photo needs one, named as the "
                "photo is. Add them, or run `refdgs-pipe adopt WORKSPACE masks --drop`"
            )
        own = set(self.names)
        items = tuple(
            replace(view, mask=str(self.path(view.name).absolute())) if view.name in own else view
            for view in views.items
        )
        return replace(views, items=items, background="masked")

    def save(self, folder: Path) -> None:
        """Write masks.json; the pictures are copied unless they are there."""
        folder.mkdir(parents=True, exist_ok=True)
        if folder != self.folder:
            for name in self.names:
                shutil.copyfile(self.path(name), folder / f"{name}.png")
        record = {"names": list(self.names), "kind": self.kind, "reason": self.reason}
        (folder / _FILE).write_text(json.dumps(record, indent=1), encoding="utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: masks.json is missing or damaged.
        """
        try:
            record = json.loads((folder / _FILE).read_text(encoding="utf-8"))
            names = tuple(str(name) for name in record["names"])
            for name in names:
                if fault := fault_of(name):
                    raise ValueError(f"{name}: {fault}")
            return cls(folder, names, record["kind"], str(record["reason"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CorruptError(f"{folder / _FILE}: {error}") from error

    @classmethod
    def adopt(cls, path: Path) -> Self:
        """A folder of masks that the user made or edited: NAME.png for each view.

        Raises:
            InputError: not a folder, it holds no PNG files, or one is damaged or shows no object.
        """
        if not path.is_dir():
            raise InputError(f"{path.name} is no folder. Give one with a PNG for each photo")
        files = sorted(p for p in path.glob("*.png") if sniff(p) == "png")
        if not files:
            raise InputError(f"{path.name} holds no PNG files. One for each photo is expected")
        for file in files:
            _check(file)
        return cls(path, tuple(file.stem for file in files), "adopted")


def _check(file: Path) -> None:
    """Refuse a mask that cannot be read or shows no object."""
    from refdgs_pipe.files.images import read_png

    try:
        mask = read_png(file)
    except CorruptError as error:
        raise InputError(
            f"{error}. Each mask has to be a PNG that is white where the object is"
        ) from error
    plain = mask if mask.ndim == 2 else mask[..., :3]
    if plain.max() <= np.iinfo(plain.dtype).max // 2:
        raise InputError(
            f"{file.name} shows no object: nothing in it is white. Draw the object white. Where a "
            "photo does not show it, leave the photo out of the capture"
        )
