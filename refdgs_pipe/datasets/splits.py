"""Which views are held out for evaluation, in the protocols of the literature."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from refdgs_pipe.artifacts.capture import Frame
from refdgs_pipe.errors import InputError

Split = Literal["auto", "nero", "every8"]

EVERY = 8
# NeRO's synthetic_split_128: 32 of the 128 views of every GlossySynthetic scene.
NERO_TEST = {
    *(0, 2, 3, 4, 5, 7, 11, 14, 19, 29, 30, 31, 33, 49, 56, 57, 59, 61, 66, 68, 71, 73, 75, 91),
    *(93, 95, 109, 110, 111, 113, 120, 127),
}


def with_split(frames: Sequence[Frame], rule: Split) -> tuple[list[Frame], str | None]:
    """The frames with their split by a rule, and what the user should know if it did not fit.

    Args:
        rule: "nero": the 32 views of NeRO, by number. "every8": the views whose number is a
            multiple of eight; without numbers every eighth by name, from the first on.

    Raises:
        InputError: NeRO's split is asked for, but the photos are not numbered.
    """
    numbers = [int(f.path.stem) for f in frames if f.path.stem.isdecimal()]
    is_numbered = len(numbers) == len(frames)
    if rule == "nero" and not is_numbered:
        raise InputError(
            "ingest.split=nero: the photos are not called 0.png, 1.png, ... as NeRO's are. "
            "Use auto or every8"
        )
    note = None
    tests = [is_numbered and number in NERO_TEST for number in numbers]
    if rule == "nero" and not _is_mixed(tests):
        missing = "none" if not any(tests) else "all"
        note = f"{missing} of the {len(frames)} photos are test views of NeRO's split: "
        note += "every eighth is held out instead"
    if rule != "nero" or note is not None:
        tests = [number % EVERY == 0 for number in numbers] if is_numbered else []
        if not _is_mixed(tests):
            tests = _every_eighth([frame.source for frame in frames])
    if not _is_mixed(tests):
        return [replace(frame, split="train") for frame in frames], note
    return [
        replace(frame, split="test" if is_test else "train")
        for frame, is_test in zip(frames, tests, strict=True)
    ], note


def _every_eighth(names: list[str]) -> list[bool]:
    held_out = set(sorted(names)[::EVERY])
    return [name in held_out for name in names]


def _is_mixed(tests: list[bool]) -> bool:
    return any(tests) and not all(tests)
