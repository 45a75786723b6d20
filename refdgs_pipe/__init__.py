"""Photos of glossy objects in, textured GLB and USDZ out."""

from pathlib import Path as _Path

__all__ = ["__version__"]
__version__ = "0.1.0"

# In a checkout, ./stages and ./recipes are sub-packages of this one, as they are once installed.
_root = _Path(__file__).resolve().parent.parent
if (_root / "csrc" / "bind.cpp").is_file() and str(_root) not in __path__:
    __path__.append(str(_root))
