"""The buttons and the panel in the sidebar of the 3D view."""

import textwrap
from collections.abc import Callable
from typing import Any

import bpy

from . import running
from .errors import AddonError
from .importing import Wanted, bring_in
from .running import STATE
from .settings import typed
from .workspace import asset_of, root_for

COLUMNS = 44  # characters of a line of the panel
Answer = set[str]


def _answer(operator: Any, act: Callable[[], object]) -> Answer:
    """Do what a button is for. An error is reported, and kept for the panel."""
    try:
        act()
    except AddonError as error:
        STATE.error = str(error)
        operator.report({"ERROR"}, STATE.error)
        return {"CANCELLED"}
    return {"FINISHED"}


class RefdgsRun(bpy.types.Operator):
    """Make the asset in the background. Finished stages are reused."""

    bl_idname = "refdgs_pipe.run"
    bl_label = "Run"

    @classmethod
    def poll(cls, context: Any) -> bool:
        """There is one run at a time."""
        return STATE.job is None

    def execute(self, context: Any) -> Answer:
        """Start it."""
        return _answer(self, lambda: running.start(context))


class RefdgsStop(bpy.types.Operator):
    """Stop at the next safe point; what is finished is kept. Press twice to stop at once."""

    bl_idname = "refdgs_pipe.stop"
    bl_label = "Stop"

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Only while a run is going on."""
        return STATE.job is not None

    def execute(self, context: Any) -> Answer:
        """Ask it to stop."""
        return _answer(self, running.stop)


class RefdgsImport(bpy.types.Operator):
    """Import the asset of the workspace, its light and the cameras of its photos."""

    bl_idname = "refdgs_pipe.bring_in"
    bl_label = "Import"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender reads it so

    def execute(self, context: Any) -> Answer:
        """Import what the boxes say."""
        return _answer(self, lambda: self._import(context))

    def _import(self, context: Any) -> None:
        settings = context.scene.refdgs_pipe
        wanted = Wanted(settings.asset, settings.light, settings.cameras)
        root = root_for(typed(settings.photos), typed(settings.workspace))
        STATE.error, STATE.result = "", bring_in(context, asset_of(root), wanted)
        self.report({"INFO"}, STATE.result)


class RefdgsTell(bpy.types.Operator):
    """Report the end of a run. It waits for an event, without which Blender shows no report."""

    bl_idname = "refdgs_pipe.tell"
    bl_label = "refdgs-pipe"
    bl_options = {"INTERNAL"}  # noqa: RUF012 - Blender reads it so
    __annotations__ = {
        "kind": bpy.props.StringProperty(default="INFO"),
        "text": bpy.props.StringProperty(),
    }

    def invoke(self, context: Any, event: Any) -> Answer:
        """Wait for the next tick of a timer."""
        self._timer = context.window_manager.event_timer_add(0.1, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: Any, event: Any) -> Answer:
        """Report, and end."""
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self._timer)
        self.report({self.kind}, self.text)
        return {"FINISHED"}


class RefdgsPanel(bpy.types.Panel):
    """The tab "refdgs-pipe" of the sidebar."""

    bl_idname = "REFDGS_PT_panel"
    bl_label = "Photos to asset"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "refdgs-pipe"

    def draw(self, context: Any) -> None:
        """Settings, Run or Stop, how far it is, Import."""
        settings, layout = context.scene.refdgs_pipe, self.layout
        column = layout.column()
        column.enabled = STATE.job is None
        for name in ("photos", "workspace", "recipe", "size"):
            column.prop(settings, name)
        if STATE.job is None:
            layout.operator(RefdgsRun.bl_idname, icon="PLAY")
        else:
            _draw_job(layout)
        _draw_words(layout, STATE.error, "ERROR")
        _draw_words(layout, STATE.result, "INFO")
        row = layout.row(align=True)
        for name in ("asset", "light", "cameras"):
            row.prop(settings, name, toggle=True)
        layout.operator(RefdgsImport.bl_idname, icon="IMPORT")


def _draw_job(layout: Any) -> None:
    """How far the run is, and the button that stops it."""
    job = STATE.job
    if job is None:
        return
    stopping = "stopping at the next safe point" if job.is_stopping else ""
    _draw_words(layout, job.progress.words, "NONE")
    if job.progress.share is not None:
        layout.progress(factor=job.progress.share, text=f"{job.progress.share:.0%} of this part")
    _draw_words(layout, stopping or job.progress.left, "NONE")
    layout.operator(RefdgsStop.bl_idname, icon="CANCEL")


def _draw_words(layout: Any, text: str, icon: str) -> None:
    """A sentence, on as many lines as it needs. Blender does not break lines."""
    column = layout.column(align=True)
    for number, line in enumerate(textwrap.wrap(text, COLUMNS)):
        column.label(text=line, icon=icon if number == 0 else "BLANK1")
