"""Results that several machines share, as the engine sees them; `refdgs_pipe.sharing` has one."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from refdgs_pipe.errors import CorruptError, DiskFault
from refdgs_pipe.pipeline.manifest import Manifest, Origin
from refdgs_pipe.pipeline.store import Store


class Shared(Protocol):
    """A place with results, by stage and key. Nothing in it is believed before it was compared."""

    def find(self, origin: Origin) -> Manifest | None:
        """The record of a result; None if there is none.

        Raises:
            CorruptError: it is not what it should be; the words name it.
            DiskFault: the place cannot be used.
        """
        ...

    def bring(self, manifest: Manifest, folder: Path) -> None:
        """Put a result's files into an empty folder, each compared with its hash.

        Raises:
            CorruptError, DiskFault: as `find`.
            OSError: the folder cannot be written.
        """
        ...

    def offer(self, manifest: Manifest, folder: Callable[[], Path]) -> None:
        """Share a finished result, unless it is there. Its record goes last.

        Args:
            folder: compares the result with its record and gives its folder; raises CorruptError.

        Raises:
            DiskFault: the place cannot be used.
        """
        ...


@dataclass
class Sharing:
    """How one run uses shared results. Their troubles are told, and never end a run.

    Args:
        shared: None: there are none; so it is after the place could not be used.
        tell: hears of troubles: stage and words.
    """

    shared: Shared | None
    store: Store
    tell: Callable[[str, str], None]
    _tried: set[str] = field(default_factory=set)  # keys
    _may_offer: bool = True
    _shared: set[str] = field(default_factory=set)  # keys of what is there, as far as is known

    def bring(self, origin: Origin) -> Manifest | None:
        """The result, now in the workspace; None if it must be made here.

        Raises:
            WriteError: the disk is full or cannot be written.
        """
        if self.shared is None or origin.adopted is not None or origin.key in self._tried:
            return None
        try:
            manifest = self.shared.find(origin)
            if manifest is None:
                return None
            self._tried.add(origin.key)
            shared = self.shared
            self.store.receive(manifest, lambda folder: shared.bring(manifest, folder))
            self._shared.add(origin.key)
            return manifest
        except CorruptError as error:
            self.tell(origin.stage, f"a shared result is refused: {error}. It is made here")
        except DiskFault as error:
            self.shared = None
            self.tell(origin.stage, f"{error}. The rest of this run shares nothing")
        return None

    def offer(self, manifest: Manifest) -> None:
        """Share a finished result that did not come from there."""
        origin = manifest.origin
        if self.shared is None or origin.adopted is not None or origin.key in self._shared:
            return
        if not self._may_offer:
            return
        self._shared.add(origin.key)
        try:
            self.shared.offer(manifest, lambda: self.store.check(manifest))
        except CorruptError:
            return  # a damaged result is found when it is read
        except DiskFault as error:  # it may be open to be read only
            self._may_offer = False
            self.tell(origin.stage, f"{error}. The rest of this run offers no results")
