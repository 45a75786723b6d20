"""How much a view may work while a run needs the machine."""

import time
from collections.abc import Callable

SHARE = 0.02  # of the core-seconds that the run may use; runs use some four fifths of these
_SAVED_S = 5.0  # core-seconds that are kept for later at most


class Effort:
    """An account of core-seconds. While a run goes on, it grows with time and is drawn on by work.

    Args:
        cores: that the run may use.
        now, spent: clocks, in seconds: the time, and the core-seconds of this process since its
            start. What was spent before a run begins or is first seen counts too.
    """

    def __init__(
        self,
        cores: int,
        *,
        now: Callable[[], float] = time.monotonic,
        spent: Callable[[], float] = time.process_time,
    ) -> None:
        self._rate = SHARE * cores
        self._now, self._spent = now, spent
        self._time, self._used = now(), 0.0
        self._saved = 0.0

    def allows(self, *, is_running: bool) -> bool:
        """Whether a piece of work may be done now."""
        now, used = self._now(), self._spent()
        earned, work = self._rate * (now - self._time), used - self._used
        self._time, self._used = now, used
        if not is_running:
            self._saved = min(self._saved + earned, 0.0)
            return True
        self._saved = min(self._saved + earned - work, _SAVED_S)
        return self._saved >= 0
