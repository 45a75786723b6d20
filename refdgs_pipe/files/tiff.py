"""The tags of a TIFF that say whether it is a camera's raw data. Nothing else is read."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

COLOR_FILTER_ARRAY, LINEAR_RAW = 32803, 34892  # PhotometricInterpretation (TIFF/EP; DNG 1.7)
# Compression: NEF, SRW, ARW, NEF, Kodak DCR, Kodak KDC, PEF, lossy DNG
MAKER_COMPRESSION = {34713, 32770, 32767, 32769, 65000, 262, 65535, 34892}
_PHOTOMETRIC, _COMPRESSION, _SUB_IFDS, _DNG = 0x106, 0x103, 0x14A, 0xC612
_SIZES = {1: 1, 3: 2, 4: 4, 13: 4}
_MOST_IFDS, _MOST_TAGS, _MOST_VALUES = 64, 1000, 64


def is_raw_tiff(path: Path) -> bool:
    """Whether a TIFF's tags call it raw: DNG, a colour filter array, or a maker's compression.

    LibRaw opens plain TIFFs, too, and develops them as if they were raw.
    """
    with path.open("rb") as file:
        head = file.read(16)
        if head[8:10] == b"CR":  # Canon CR2 says so beside the tags
            return True
        return any(_says_raw(tags) for tags in _directories(file, head))


def _says_raw(tags: dict[int, list[int]]) -> bool:
    compression = tags.get(_COMPRESSION, [1])[:1]
    return (
        _DNG in tags
        or tags.get(_PHOTOMETRIC, [2])[:1] in ([COLOR_FILTER_ARRAY], [LINEAR_RAW])
        or bool(set(compression) & MAKER_COMPRESSION)
    )


def _directories(file: BinaryIO, head: bytes) -> Iterator[dict[int, list[int]]]:
    """The whole numbers of every directory and sub-directory."""
    order = "<" if head[:2] == b"II" else ">"
    if len(head) < 8:
        return
    waiting, seen = [struct.unpack(order + "I", head[4:8])[0]], set[int]()
    while waiting and len(seen) < _MOST_IFDS:
        at = waiting.pop()
        if at == 0 or at in seen:
            continue
        seen.add(at)
        tags, following = _directory(file, order, at)
        waiting += [following, *tags.get(_SUB_IFDS, [])]
        yield tags


def _directory(file: BinaryIO, order: str, at: int) -> tuple[dict[int, list[int]], int]:
    file.seek(at)
    count = file.read(2)
    number = struct.unpack(order + "H", count)[0] if len(count) == 2 else 0
    if not 0 < number <= _MOST_TAGS:
        return {}, 0
    block = file.read(12 * number + 4)
    if len(block) < 12 * number:
        return {}, 0
    tags: dict[int, list[int]] = {}
    for i in range(number):
        tag, kind, length = struct.unpack(order + "HHI", block[12 * i : 12 * i + 8])
        size = _SIZES.get(kind, 0)
        if size == 0 or not 0 < length <= _MOST_VALUES:
            tags[tag] = []
            continue
        data = block[12 * i + 8 : 12 * i + 12]
        if size * length > 4:
            file.seek(struct.unpack(order + "I", data)[0])
            data = file.read(size * length)
        if len(data) >= size * length:
            code = {1: "B", 2: "H", 4: "I"}[size]
            tags[tag] = list(struct.unpack(f"{order}{length}{code}", data[: size * length]))
    rest = block[12 * number :]
    return tags, struct.unpack(order + "I", rest)[0] if len(rest) == 4 else 0
