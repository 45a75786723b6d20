"""What the shell offers when Tab is pressed: recipes, stages, settings, devices.

`refdgs-pipe --install-completion` teaches it to the shell. These functions run at every press of
Tab, so they load nothing heavy and never fail.
"""

from contextlib import suppress

from refdgs_pipe import recipe
from refdgs_pipe.pipeline import catalog

DEVICES = {
    "auto": "a GPU if there is one that can be used",
    "cpu": "the processor",
    "cuda": "an NVIDIA GPU",
    "cuda:0": "the NVIDIA GPU with this number in nvidia-smi",
}


def recipes(incomplete: str) -> list[tuple[str, str]]:
    """The recipes that come with the product, and what each is for."""
    names = [name for name in recipe.names() if name.startswith(incomplete)]
    return [(name, recipe.load(name).about) for name in names]


def recipe_lists(incomplete: str) -> list[str]:
    """The same after a comma: "glossy,ma" gives "glossy,matte"."""
    before, comma, last = incomplete.rpartition(",")
    return [f"{before}{comma}{name}" for name in recipe.names() if name.startswith(last)]


def stages(incomplete: str) -> list[str]:
    """The names of the stages, in order."""
    with suppress(Exception):  # a broken installation must not break the shell
        names = [stage.name for stage in catalog.load_stages()]
        return [name for name in names if name.startswith(incomplete)]
    return []


def settings(incomplete: str) -> list[tuple[str, str]]:
    """Every "stage.setting=", and what it means."""
    found = []
    with suppress(Exception):
        for stage in catalog.load_stages():
            for key, info in stage.params.model_fields.items():
                if (name := f"{stage.name}.{key}=").startswith(incomplete):
                    found.append((name, str(info.description or "")))
    return found


def devices(incomplete: str) -> list[tuple[str, str]]:
    """What `--device` takes."""
    return [(name, told) for name, told in DEVICES.items() if name.startswith(incomplete)]
