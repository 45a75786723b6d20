"""Room for lists whose length only the GPU knows, planned so that nothing waits to learn it."""

from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from torch import Tensor

from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops import addresses

LISTS = 8  # that one step may ask room for
MARGIN = 1.5  # room for this many times what was needed at most
SLACK = 1.1  # room that is kept where it is must be for this many times what was needed
LADDER = 1.2  # room grows by such steps, so that memory of the same size is asked for again
LEAST = 4096
FORGETS = 0.8  # of what was needed at most, kept when the surfels change
LAG = 4  # steps after which a GPU's numbers are read

Kind = tuple[object, ...]
Asked = list[tuple[Kind, int, int]]  # lists of a step: kind, items and room
Note = TypeVar("Note")


class Plan:
    """What every list of a step may take, from what it took before.

    The first list of its kind is counted and waited for. From then on kernels are given room for
    MARGIN times the most that was seen for each item, they write how much they needed, and where
    that is more than the room they raise `misfit`: such a step must change nothing, and be done
    again once `learn` has seen it.

    Attributes:
        misfit: () float32 on the device, 1 where a list of the step did not fit.
        needed: (LISTS,) int64 on the device, what the step's lists needed.
    """

    def __init__(self, device: str) -> None:
        self.misfit = torch.zeros((), device=device)
        self.needed = torch.zeros(LISTS, dtype=torch.int64, device=device)
        self._most: dict[Kind, float] = {}  # needed for each item
        self._since: dict[Kind, float] = {}  # the same since the last `settle`
        self._limits: dict[Kind, int] = {}  # lists are never longer
        self._asked: Asked = []

    def begin(self) -> None:
        """A new step: its lists are asked for in the order of the last one's."""
        self._asked = []
        self.misfit.zero_()

    def room(self, *kind: object, items: int, most: int, count: Callable[[], int]) -> int:
        """How long this step's next list may be.

        Args:
            kind: lists of one kind and place in the step need alike for each item.
            most: the list is never longer.
            count: says how long it is, after a wait; asked for the first of a kind.

        Raises:
            ShapeError: the last one of its kind was longer than possible.
        """
        key = (len(self._asked), *kind)
        if key not in self._most:
            self._most[key] = count() / max(items, 1)
        if self._most[key] * items > most:
            raise ShapeError(f"a list of {self._most[key] * items:.3g}; at most {most} is possible")
        room = LEAST
        while room < MARGIN * self._most[key] * items:
            room = int(room * LADDER) + 1
        room = min(room, most)
        self._asked.append((key, items, room))
        self._limits[key] = most
        return room

    def holds(self, asked: Asked) -> bool:
        """Whether the lists of an earlier step have room, and some to spare, for another one."""
        return all(
            room >= min(SLACK * self._most[key] * items, self._limits[key])
            for key, items, room in asked
        )

    def last(self) -> Tensor:
        """(1,) what the list last asked for needed, once kernels have written it."""
        at = len(self._asked) - 1
        return self.needed[at : at + 1]

    def places(self) -> list[int]:
        """Addresses where kernels write what the list last asked for needed, and the misfit."""
        return addresses.each((self.last(), self.misfit))

    def asked(self) -> Asked:
        """The step's lists, for `learn`."""
        return self._asked

    def learn(self, asked: Asked, needed: Tensor) -> bool:
        """Whether all lists of a step did fit.

        Args:
            needed: (LISTS,) that step's, on the CPU.
        """
        fits = True
        for (key, items, room), count in zip(asked, needed.tolist(), strict=False):
            share = count / max(items, 1)
            self._most[key] = max(self._most[key], share)
            self._since[key] = max(self._since.get(key, 0.0), share)
            fits &= count <= room
        return fits

    def settle(self) -> None:
        """The surfels have changed: what was needed long ago counts less."""
        for key, share in self._most.items():
            self._most[key] = max(self._since.get(key, share), FORGETS * share)
        self._since.clear()


class Readback(Generic[Note]):
    """Numbers of steps on their way from the GPU, read LAG steps later; on a CPU at once.

    The lag is fixed, so what follows from them does not depend on the GPU's speed.
    """

    def __init__(self, device: str, lag: int | None = None) -> None:
        self._on_gpu = device != "cpu"
        self._lag = LAG * self._on_gpu if lag is None else lag
        self._sent: list[tuple[Note, list[Tensor], torch.cuda.Event | None]] = []

    def send(self, note: Note, *numbers: Tensor) -> None:
        """Have a step's numbers brought to the CPU."""
        if not self._on_gpu:
            self._sent.append((note, [n.detach().clone() for n in numbers], None))
            return
        brought = [n.detach().to("cpu", non_blocking=True) for n in numbers]  # pinned by torch
        event = torch.cuda.Event()  # type: ignore[no-untyped-call]
        event.record()
        self._sent.append((note, brought, event))

    def arrived(self, *, all_of_them: bool = False) -> list[tuple[Note, list[Tensor]]]:
        """What has not been read yet of all steps but the last LAG; or of all, after a wait."""
        count = len(self._sent) if all_of_them else max(0, len(self._sent) - self._lag)
        out = []
        for note, numbers, event in self._sent[:count]:
            if event is not None:
                event.synchronize()
            out.append((note, numbers))
        del self._sent[:count]
        return out
