"""Arrays out of a pickle without unpickling it.

A pickle is a program, and Python's own reader calls whatever it names. Here a small machine follows
the instructions by which numpy writes arrays, on stand-ins: nothing is imported, called or looked
up. Everything else is refused. Format: PEP 307, 3154, 574; `ndarray.__reduce__` of numpy 1 and 2.
"""

import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.errors import CorruptError

F64 = NDArray[np.float64]

MAX_BYTES = 1 << 16  # a camera takes some 400
MAX_SIDE = 4096
_CORES = ("numpy.core", "numpy._core")  # numpy 1 and 2
_RECONSTRUCT = {f"{core}.multiarray _reconstruct" for core in _CORES}
_FROMBUFFER = {f"{core}.numeric _frombuffer" for core in _CORES}
_ENCODE = "_codecs encode"  # how Python 3 writes bytes at protocol 2
_KNOWN = {*_RECONSTRUCT, *_FROMBUFFER, _ENCODE, "numpy ndarray", "numpy dtype"}
_KINDS = {"f4", "f8", "i4", "i8"}
_LITERALS = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "BINFLOAT", "FLOAT"),
    *("UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
    *("STRING", "SHORT_BINSTRING", "BINSTRING"),
    *("SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8"),
}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}


def read_pickled_arrays(path: Path) -> tuple[F64, ...]:
    """The arrays of a pickled tuple of numpy arrays, as float64. Nothing in the file is run.

    Raises:
        CorruptError: the file cannot be read, is damaged, or holds anything else than such arrays.
    """
    try:
        data = path.read_bytes() if path.stat().st_size <= MAX_BYTES else None
    except OSError as error:
        raise CorruptError(f"{path}: cannot be read ({error.strerror})") from None
    if data is None:
        raise CorruptError(f"{path}: larger than {MAX_BYTES} bytes, so no camera. {_ADVICE}")
    try:
        made = _Machine().run(data)
        if not isinstance(made, tuple):
            raise _Refused("something else than a tuple")
        return tuple(_as_numpy(item) for item in made)
    except _Refused as refused:
        raise CorruptError(f"{path}: holds {refused}. {_ADVICE}") from None
    except (ValueError, IndexError, KeyError, TypeError, OverflowError) as error:
        raise CorruptError(f"{path}: damaged pickle ({error}). {_ADVICE}") from None


_ADVICE = (
    "Expected only numpy arrays in a tuple; nothing in it was run. Copy the file again from where "
    "it came from, and distrust it if it stays so"
)


class _Refused(Exception):
    """What the pickle holds that is not read."""


class _Mark:
    """Where the items of a tuple begin on the stack."""


@dataclass(frozen=True)
class _Name:
    """Stands in for what a pickle would import; "module name"."""

    text: str


@dataclass
class _Dtype:
    """Stands in for a numpy dtype."""

    kind: Any
    order: Any = "="


@dataclass
class _Array:
    """Stands in for a numpy array; filled by what follows in the pickle."""

    shape: Any = None
    dtype: Any = None
    is_fortran: bool = False
    data: Any = None


class _Machine:
    """The stack and the memo of a pickle that is being read."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self, data: bytes) -> Any:
        """What the pickle leaves on the stack."""
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name in _LITERALS:
                self.stack.append(argument)
            elif opcode.name in _CONSTANTS:
                self.stack.append(_CONSTANTS[opcode.name])
            elif opcode.name in _STEPS:
                _STEPS[opcode.name](self, argument)
            elif opcode.name not in ("PROTO", "FRAME", "STOP"):
                raise _Refused(f"the instruction {opcode.name}")
        return self.stack.pop()

    def name(self, text: str) -> None:
        if text not in _KNOWN:
            raise _Refused(f"the name {text[:80]!r}")
        self.stack.append(_Name(text))

    def stack_name(self) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        if not isinstance(name, str) or not isinstance(module, str):
            raise _Refused("a name that is no text")
        self.name(f"{module} {name}")

    def tuple_of(self, count: int) -> None:
        if len(self.stack) < count:
            raise IndexError("a tuple of more than there is")
        items = tuple(self.stack[-count:])
        del self.stack[-count:]
        self.stack.append(items)

    def tuple_from_mark(self) -> None:
        items: list[Any] = []
        while not isinstance(item := self.stack.pop(), _Mark):
            items.append(item)
        self.stack.append(tuple(reversed(items)))

    def put(self, index: int) -> None:
        self.memo[index] = self.stack[-1]

    def reduce(self) -> None:
        """A call, of the few that numpy's arrays consist of, on stand-ins."""
        arguments, called = self.stack.pop(), self.stack.pop()
        text = called.text if isinstance(called, _Name) else ""
        if text in _RECONSTRUCT:
            self.stack.append(_Array())
        elif text in _FROMBUFFER:
            data, dtype, shape, order = arguments
            self.stack.append(_Array(shape, dtype, order == "F", data))
        elif text == "numpy dtype":
            self.stack.append(_Dtype(arguments[0]))
        elif text == _ENCODE and all(isinstance(argument, str) for argument in arguments):
            self.stack.append(arguments[0].encode("latin-1"))
        else:
            raise _Refused(f"a call of {text!r}" if text else "a call of what is no function")

    def build(self) -> None:
        """The second half of an array or a dtype."""
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, _Array):
            _, target.shape, target.dtype, fortran, target.data = state
            target.is_fortran = fortran is True or fortran == 1
        elif isinstance(target, _Dtype):
            target.order = state[1]
        else:
            raise _Refused("a state for what is no array")


_STEPS: dict[str, Callable[[_Machine, Any], None]] = {
    "GLOBAL": lambda machine, text: machine.name(text),
    "STACK_GLOBAL": lambda machine, _: machine.stack_name(),
    "MARK": lambda machine, _: machine.stack.append(_Mark()),
    "TUPLE": lambda machine, _: machine.tuple_from_mark(),
    "TUPLE1": lambda machine, _: machine.tuple_of(1),
    "TUPLE2": lambda machine, _: machine.tuple_of(2),
    "TUPLE3": lambda machine, _: machine.tuple_of(3),
    "REDUCE": lambda machine, _: machine.reduce(),
    "BUILD": lambda machine, _: machine.build(),
    "MEMOIZE": lambda machine, _: machine.put(len(machine.memo)),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), lambda machine, i: machine.put(i)),
    **dict.fromkeys(
        ("GET", "BINGET", "LONG_BINGET"), lambda machine, i: machine.stack.append(machine.memo[i])
    ),
}


def _as_numpy(made: Any) -> F64:
    """An array of a stand-in, after a check that its bytes are as many as its shape says."""
    if not isinstance(made, _Array) or not isinstance(made.dtype, _Dtype):
        raise _Refused("something else than arrays in its tuple")
    kind, order, shape = made.dtype.kind, made.dtype.order, made.shape
    if not isinstance(kind, str) or kind not in _KINDS or order not in ("<", ">", "="):
        raise _Refused("an array of something else than plain numbers")
    sides = shape if isinstance(shape, tuple) else ()
    if not 1 <= len(sides) <= 2 or not all(type(n) is int and 0 < n <= MAX_SIDE for n in sides):
        raise _Refused("an array that is no matrix")
    data = made.data.encode("latin-1") if isinstance(made.data, str) else made.data
    wanted = int(np.prod(sides)) * int(kind[1])
    if not isinstance(data, bytes | bytearray) or len(data) != wanted:
        raise _Refused(f"an array whose bytes are not the {wanted} of its shape")
    values = np.frombuffer(data, np.dtype("<" + kind if order == "=" else order + kind))
    return values.reshape(sides, order="F" if made.is_fortran else "C").astype(np.float64)
