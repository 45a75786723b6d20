"""Write the files of one target."""

import shutil
from collections.abc import Callable

from refdgs_pipe.artifacts.asset import Delivery
from refdgs_pipe.child_process import ChildCrashed
from refdgs_pipe.errors import ExportError, MeshError, OutOfMemory
from refdgs_pipe.export.targets.ar import ar
from refdgs_pipe.export.targets.film import film
from refdgs_pipe.export.targets.game import game
from refdgs_pipe.export.targets.names import FOLDER, Target
from refdgs_pipe.export.targets.order import Made, Order
from refdgs_pipe.export.targets.printing import print_
from refdgs_pipe.export.targets.web import web

_MAKERS = {"web": web, "ar": ar, "game": game, "film": film, "print": print_}


def deliver(name: Target, order: Order, warn: Callable[[str], None]) -> Delivery:
    """Write and check the files of a target, in targets/NAME of the exported files.

    A target that cannot be made has no files, and does not cost the asset.

    Args:
        warn: told where the result is not what the target promises.

    Raises:
        OutOfMemory: there is not enough; more of it may make the target.
    """
    folder = order.folder / FOLDER / name
    folder.mkdir(parents=True)
    try:
        made: Made = _MAKERS[name](order, folder)
    except (ChildCrashed, ExportError, MeshError) as error:
        if isinstance(error, OutOfMemory):
            raise
        shutil.rmtree(folder)
        warn(f"target {name} was not made: {error}")
        return Delivery(name, (), "not made", {}, (str(error),))
    for text in made.warnings:
        warn(text)
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    files = tuple(path.relative_to(order.folder).as_posix() for path in paths)
    return Delivery(name, files, made.summary, made.figures, made.notes)
