"""Write the files of one target."""

from collections.abc import Callable

from refdgs_pipe.artifacts.asset import Delivery
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

    Args:
        warn: told where the result is not what the target promises.

    Raises:
        ExportError: a file did not pass its check.
    """
    folder = order.folder / FOLDER / name
    folder.mkdir(parents=True)
    made: Made = _MAKERS[name](order, folder)
    for text in made.warnings:
        warn(text)
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    files = tuple(path.relative_to(order.folder).as_posix() for path in paths)
    return Delivery(name, files, made.summary, made.figures, made.notes)
