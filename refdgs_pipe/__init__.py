"""Photos of glossy objects in, textured GLB and USDZ out.

docs/python.md shows how to use it from Python. Importing the package loads no library; each name
of `__all__` is loaded when it is first used.
"""

from importlib import import_module as _import_module
from pathlib import Path as _Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from refdgs_pipe.api import (
        Result,
        load_asset,
        load_cameras,
        load_field,
        load_mesh,
        render,
        run,
    )
    from refdgs_pipe.camera import Camera
    from refdgs_pipe.errors import RefdgsError

__all__ = [
    "Camera",
    "RefdgsError",
    "Result",
    "__version__",
    "load_asset",
    "load_cameras",
    "load_field",
    "load_mesh",
    "render",
    "run",
]
__version__ = "0.1.0"

_HOMES = {"Camera": "camera", "RefdgsError": "errors"}  # the others are in `api`

# In a checkout, ./stages and ./recipes are sub-packages of this one, as they are once installed.
_root = _Path(__file__).resolve().parent.parent
if (_root / "csrc" / "bind.cpp").is_file() and str(_root) not in __path__:
    __path__.append(str(_root))


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_import_module(f"{__name__}.{_HOMES.get(name, 'api')}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
