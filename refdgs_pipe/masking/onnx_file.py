"""A look into an ONNX file before any library reads it: nothing in it may reach outside."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from refdgs_pipe.errors import InputError

MOST_BYTES = 2_000_000_000  # protobuf cannot hold more than 2 GiB
MOST_PARTS = 5_000_000  # fields that are looked at; large networks have some hundred thousand
DEEPEST = 64  # graphs in graphs
BUILT_IN = {"", "ai.onnx", "ai.onnx.ml", "com.microsoft"}  # operators of onnxruntime itself

# message -> field -> the message in it, of all that can hold a tensor or an operator (onnx.proto)
_INSIDE: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "function": {7: "node", 11: "attribute"},
    "training": {1: "graph", 2: "graph"},
    "tensor": {},
}
_DOMAIN = {"node": 7, "function": 10}
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14  # of a tensor
_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5  # protobuf's wire types


class _NotOnnx(Exception):
    """The bytes are no protobuf message."""


@dataclass
class _Seen:
    """What a walk through a file came by."""

    parts: int = 0
    has_graph: bool = False
    is_external: bool = False
    used: set[str] = field(default_factory=set)  # domains of operators
    defined: set[str] = field(default_factory=set)  # domains that the file's own functions define


def check_size(path: Path) -> None:
    """Refuse what is no file, or too large for a network.

    Raises:
        InputError: so it is.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: no such file. Give your network as an ONNX file: --mask-model FILE.onnx; "
            'or go without one: --mask-model ""'
        )
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise InputError(
            f"{path}: {size / 1e9:.1f} GB. A network may have {MOST_BYTES / 1e9:.0f} GB, all of it "
            "in one file. Export a smaller one"
        )


def digest_of(data: bytes, like: str = "") -> str:
    """The hash of a file's bytes, as the engine has it; `like` as in its `hasher`."""
    return hashlib.blake2b(data, digest_size=16 if len(like) == 32 else 32).hexdigest()


def read_network(path: Path, digest: str) -> bytes:
    """The bytes of an ONNX file that holds all of its data and only known operators.

    Args:
        digest: the content that is expected.

    Raises:
        InputError: the file cannot be read, has another content, or is refused.
    """
    check_size(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Give another file") from None
    if digest_of(data, digest) != digest:
        raise InputError(f"{path}: the file was changed after the run began. Run again")
    check_content(data, str(path))
    return data


def check_content(data: bytes, label: str) -> None:
    """Refuse what is not ONNX, refers to other files or has operators of its own.

    Args:
        label: how messages call the file.

    Raises:
        InputError: so it is.
    """
    try:
        seen = _walked(data)
    except (_NotOnnx, IndexError):
        seen = _Seen()
    if not seen.has_graph:
        raise InputError(
            f"{label}: not an ONNX model. An .onnx file is expected, as torch.onnx.export writes "
            "it; weights of another kind (.pt, .pth, .safetensors, .ort) have to be exported first"
        )
    if seen.is_external:
        raise InputError(
            f"{label}: its weights are in another file (external data), which is not read. Export "
            "all into one file: onnx.save_model(onnx.load(FILE), OTHER, save_as_external_data="
            "False); torch.onnx.export has external_data=False"
        )
    foreign = sorted(seen.used - seen.defined - BUILT_IN)
    if foreign:
        raise InputError(
            f"{label}: has custom operators ({', '.join(foreign[:3])}), which need a library of "
            "their own. Only ONNX's operators are known: export the network without them"
        )


def _walked(data: bytes) -> _Seen:
    """Look at every message that can hold a tensor or an operator."""
    seen, waiting = _Seen(), [("model", 0, len(data), 0)]
    while waiting:
        kind, start, end, depth = waiting.pop()
        if depth > DEEPEST:
            raise _NotOnnx
        for number, wire, first, last in _fields(data, start, end):
            seen.parts += 1
            if seen.parts > MOST_PARTS:
                raise _NotOnnx
            inside = _INSIDE[kind].get(number)
            if wire == _LENGTH and inside:
                seen.has_graph |= kind == "model" and inside == "graph"
                waiting.append((inside, first, last, depth + 1))
            elif kind == "tensor":
                seen.is_external |= wire == _LENGTH and number == _EXTERNAL_DATA
                seen.is_external |= wire == _VARINT and number == _DATA_LOCATION and first != 0
            elif wire == _LENGTH and number == _DOMAIN.get(kind):
                names = seen.used if kind == "node" else seen.defined
                names.add(data[first:last].decode("utf-8", "replace"))
    return seen


def _fields(data: bytes, at: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """(number, wire type, first, last) of a message's fields: the value's place, or its value."""
    while at < end:
        tag, at = _varint(data, at)
        number, wire = tag >> 3, tag & 7
        if not 0 < number < 1 << 29:
            raise _NotOnnx
        if wire == _VARINT:
            value, at = _varint(data, at)
            yield number, wire, value, value
            continue
        if wire == _LENGTH:
            length, at = _varint(data, at)
        else:
            length = {_FIXED64: 8, _FIXED32: 4}.get(wire, -1)
        if length < 0 or at + length > end:
            raise _NotOnnx
        yield number, wire, at, at + length
        at += length
    if at != end:
        raise _NotOnnx


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of up to ten bytes, and what comes after it."""
    value = 0
    for i in range(10):
        byte = data[at + i]
        value |= (byte & 0x7F) << 7 * i
        if byte < 0x80:
            return value, at + i + 1
    raise _NotOnnx
