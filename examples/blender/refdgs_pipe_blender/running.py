"""The one run of this Blender, and the timer that looks at it. Blender stays usable meanwhile.

A timer of `bpy.app.timers` and no modal operator: a modal operator that lasts as long as a run
would keep Blender from saving its automatic copies.
"""

from typing import Any

import bpy

from .errors import AddonError
from .job import Ending, Job
from .program import find, run_command
from .settings import chosen_program, order_of
from .workspace import root_for

EVERY_S = 0.5


class State:
    """What the panel shows.

    Attributes:
        job: the run that is going on, or None.
        error: the last error, one sentence; "" if there is none.
        result: how the last run or import ended, if it went well; else "".
    """

    job: Job | None = None
    error: str = ""
    result: str = ""


STATE = State()


def start(context: Any) -> None:
    """Start a run of what the panel asks for, and the timer.

    Raises:
        AddonError: a run is going on, or this one cannot be started.
    """
    if STATE.job is not None:
        raise AddonError("A run is going on. Wait for its end, or press Stop")
    STATE.error = STATE.result = ""
    order = order_of(context.scene.refdgs_pipe)
    command = run_command(find(chosen_program(context)), order)
    STATE.job = Job.start(command, root_for(order.photos, order.workspace))
    if not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=EVERY_S, persistent=True)


def tick() -> float | None:
    """Look at the run. Return the seconds until the next look; None after its end."""
    job = STATE.job
    if job is None:
        return None
    ending = job.poll()
    redraw()
    if ending is None:
        return EVERY_S
    STATE.job = None
    STATE.error = ending.words if ending.is_error else ""
    STATE.result = "" if ending.is_error else ending.words
    _tell(ending)
    return None


def stop() -> None:
    """Ask the run to stop. A second call ends it at once.

    Raises:
        AddonError: no run is going on.
    """
    if STATE.job is None:
        raise AddonError("No run is going on")
    STATE.job.stop()


def leave() -> None:
    """Blender closes, or the add-on is switched off: stop the run and forget it."""
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    if STATE.job is not None:
        STATE.job.leave()
        STATE.job = None


def redraw() -> None:
    """Draw the panels again."""
    manager = bpy.context.window_manager
    for window in manager.windows if manager else ():
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def _tell(ending: Ending) -> None:
    """Let Blender report the end. A timer has no window, so it takes the first one."""
    manager = bpy.context.window_manager
    if bpy.app.background or not manager or not manager.windows:
        return
    kind = "ERROR" if ending.is_error else "INFO"
    with bpy.context.temp_override(window=manager.windows[0]):
        bpy.ops.refdgs_pipe.tell("INVOKE_DEFAULT", kind=kind, text=ending.words)
