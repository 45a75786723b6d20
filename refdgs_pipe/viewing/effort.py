"""How much a view may work while a run needs the machine."""

import time
from collections.abc import Callable

SHARE = 0.03  # of the core-seconds that the run has spent
_SAVED_S = 5.0  # core-seconds that are kept for later at most
_BUSY = 0.7  # of its cores are used by a run whose core-seconds are not known


class Effort:
    """An account of core-seconds. What a run spends adds to it, what the view does takes from it.

    Args:
        cores: that a run may use.
        now, spent: clocks, in seconds: the time, and the core-seconds of this process since its
            start. What was spent before a run is first seen is taken off too.
    """

    def __init__(
        self,
        cores: int,
        *,
        now: Callable[[], float] = time.monotonic,
        spent: Callable[[], float] = time.process_time,
    ) -> None:
        self._cores, self._now, self._spent = cores, now, spent
        self._time, self._used = now(), 0.0
        self._run: float | None = None
        self._saved = 0.0

    def allows(self, *, is_running: bool, run_s: float | None) -> bool:
        """Whether a piece of work may be done now.

        Args:
            run_s: core-seconds that the run has spent, if that can be told.
        """
        now, used = self._now(), self._spent()
        passed, work = now - self._time, used - self._used
        self._time, self._used = now, used
        before, self._run = self._run, run_s if is_running else None
        if not is_running:
            self._saved = min(self._saved + SHARE * self._cores * passed, 0.0)
            return True
        if run_s is None:
            earned = SHARE * _BUSY * self._cores * passed
        else:
            earned = 0.0 if before is None else SHARE * max(0.0, run_s - before)
        self._saved = min(self._saved + earned - work, _SAVED_S)
        return self._saved >= 0
