"""The panel beside the scene: how the run goes, what is shown, and the ball and up direction."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from refdgs_pipe.formatting import duration, printable
from refdgs_pipe.viewing.adjusting import Choice, assignments, tilted
from refdgs_pipe.viewing.contents import Scene, summary
from refdgs_pipe.viewing.drawing import KINDS
from refdgs_pipe.viewing.story import Point
from refdgs_pipe.viewing.watching import Seen

OBJECTS = ("newest", "field", "mesh", "asset", "none")
LAYERS = ("cameras", "points", "ball", "plane")
_CURVE = 400  # points of a curve at most
_LEAN = 60.0  # degrees, either way


@dataclass(frozen=True)
class Told:
    """What the panel tells besides what was seen.

    Args:
        troubles: what cannot be shown, a sentence each.
        shown: what of the object is shown, in words.
    """

    troubles: Sequence[str]
    shown: str


class Panel:
    """viser's panel. All words of the workspace go into it as escaped HTML.

    Args:
        gui: viser's GuiApi.
        stages: name -> what it does, in order.
        run: the command that goes on with this workspace, without settings.
        remember: writes settings to the workspace and says in a sentence what came of it.
        changed: called when the user chose something else to look at.
    """

    def __init__(
        self,
        gui: Any,
        *,
        stages: Mapping[str, str],
        run: str,
        remember: Callable[[list[str]], str],
        changed: Callable[[], None],
    ) -> None:
        self._gui, self._stages, self._run, self._remember = gui, stages, run, remember
        self._said: dict[int, str] = {}
        self._curve: tuple[Point, ...] = ()
        self._state = gui.add_html("")
        self._plots: Any = None
        with gui.add_folder("Show"):
            self.object = gui.add_dropdown("object", OBJECTS, hint="what of the object is drawn")
            self.kind = gui.add_dropdown("field as", KINDS, hint="which map of the field is drawn")
            self.layers = {name: gui.add_checkbox(name, True) for name in LAYERS}
            self.masks = gui.add_checkbox("masks on photos", True)
        for handle in (self.object, self.kind, *self.layers.values(), self.masks):
            handle.on_update(lambda _: changed())
        self.training = gui.add_folder("Training", expand_by_default=True, visible=False)
        self._adjusting: _Adjusting | None = None
        self._rows = gui.add_folder("Stages", expand_by_default=False)
        with self._rows:
            self._table = gui.add_html("")

    def tell(self, seen: Seen, told: Told) -> None:
        """Say how the run goes."""
        self._put(self._state, state_html(seen, told))
        self._put(self._table, table_html(seen, self._stages))
        if seen.story.curve != self._curve and len(seen.story.curve) > 1:
            self._draw(seen.story.curve)

    def place(self, scene: Scene, moved: Callable[[Choice], None], api: Any) -> None:
        """Offer the ball and the up direction of a scene for adjustment.

        Args:
            moved: called with each choice.
            api: viser's SceneApi, for the handle at the ball's centre.
        """
        if self._adjusting is not None:
            self._adjusting.remove()
        self._adjusting = _Adjusting(self._gui, api, scene, self._run, self._remember, moved)

    def _put(self, handle: Any, content: str) -> None:
        """Send a text if it is another one."""
        if self._said.get(id(handle)) != content:
            self._said[id(handle)] = handle.content = content

    def _draw(self, curve: tuple[Point, ...]) -> None:
        self._curve = curve
        few = np.unique(np.linspace(0, len(curve) - 1, min(len(curve), _CURVE)).round().astype(int))
        steps, loss, psnr = np.array([curve[i] for i in few], float).T
        if self._plots is None:
            self.training.visible = True
            with self.training:
                self._plots = (
                    _plot(self._gui, "loss", "#d62728", log=True),
                    _plot(self._gui, "PSNR, dB", "#1f77b4", log=False),
                )
        for handle, values in zip(self._plots, (np.maximum(loss, 1e-9), psnr), strict=True):
            handle.data = (steps, values)


def _plot(gui: Any, label: str, color: str, *, log: bool) -> Any:
    from viser import uplot

    none = np.array([0.0, 1.0])
    return gui.add_uplot(
        (none, none),
        (uplot.Series(label="step"), uplot.Series(label=label, stroke=color, width=2)),
        title=label,
        scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(distr=3 if log else 1)},
        height=150,
    )


def state_html(seen: Seen, told: Told) -> str:
    """What is going on, what is shown, and what cannot be shown, as HTML."""
    story = seen.story
    if seen.is_running:
        spent = duration(max(0.0, time.time() - story.begun)) if story.begun else ""
        does = f"{story.stage}: {story.label}" if story.stage and story.label else story.stage
        count = f" {story.done}/{story.total}" if story.total and story.stage else ""
        lines = [f"<b>running</b> {escape(printable(does or 'between stages'))}{count}"]
        lines += [f"for {spent}"] if spent else []
    elif not seen.results and not seen.troubles:
        lines = ["<b>nothing is here yet</b>"]
    else:
        lines = ["<b>no run is going on</b>"]
        if story.failure:
            lines.append(f"the last run ended: {escape(printable(story.failure))}")
    if story.curve:
        step, loss, psnr = story.curve[-1]
        total = f" of {story.steps}" if story.steps else ""
        lines.append(f"training: step {step}{total}, loss {loss:.4g}, {psnr:.2f} dB")
    if seconds := sum(found.manifest.seconds for found in seen.results.values()):
        lines.append(f"finished stages took {duration(seconds)}")
    if told.shown:
        lines.append(f"shown: {escape(printable(told.shown))}")
    bad = "".join(f"<li>{escape(printable(text))}</li>" for text in told.troubles)
    html = "".join(f"<div>{line}</div>" for line in lines)
    html += f"<ul style='color:#b00020'>{bad}</ul>" if bad else ""
    return f"<div style='padding:0.5em 0.8em;font-size:0.85em'>{html}</div>"


def table_html(seen: Seen, stages: Mapping[str, str]) -> str:
    """The stages, how they stand, and how long they took, as HTML."""
    cells = [
        (name, state, duration(seconds) if seconds is not None else "")
        for name, state, seconds in summary(seen, stages)
    ]
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(printable(cell))}</td>" for cell in row) + "</tr>"
        for row in cells
    )
    return f"<table style='width:100%;font-size:0.85em;padding:0 0.8em'>{rows}</table>"


class _Adjusting:
    """The part of the panel where ball and up direction are chosen by hand."""

    def __init__(
        self,
        gui: Any,
        api: Any,
        scene: Scene,
        run: str,
        remember: Callable[[list[str]], str],
        moved: Callable[[Choice], None],
    ) -> None:
        self._scene, self._run, self._moved = scene, run, moved
        ball, step = scene.model.ball, 0.005 * scene.model.ball.radius
        self._folder = gui.add_folder("Ball and up", expand_by_default=False)
        with self._folder:
            self._handle = gui.add_checkbox("handle in the scene", False)
            self._center = gui.add_vector3("centre", tuple(ball.center), step=step)
            self._radius = gui.add_number("radius", ball.radius, min=step, step=step)
            self._lean = [
                gui.add_slider(f"up leans {way}", -_LEAN, _LEAN, 0.5, 0.0) for way in ("x", "y")
            ]
            self._command = gui.add_html("")
            self._button = gui.add_button("Remember in the workspace", disabled=True)
            self._reset = gui.add_button("As it was")
            self._answer = gui.add_html("")
        self._gizmo = api.add_transform_controls(
            "/handle",
            scale=0.6 * ball.radius,
            position=tuple(ball.center),
            disable_rotations=True,
            visible=False,
        )
        for number in (self._center, self._radius, *self._lean):
            number.on_update(lambda _: self._update())
        self._gizmo.on_update(lambda _: self._dragged())
        self._handle.on_update(lambda _: self._toggle())
        self._button.on_click(lambda _: self._write(remember))
        self._reset.on_click(lambda _: self._restore())

    @property
    def choice(self) -> Choice:
        """What is chosen now."""
        up = tilted(self._scene.model.up, *(float(s.value) for s in self._lean))
        return Choice(np.array(self._center.value, float), float(self._radius.value), up)

    def remove(self) -> None:
        """Take it away."""
        self._gizmo.remove()
        self._folder.remove()

    def _update(self) -> None:
        choice = self.choice
        chosen = assignments(self._scene, choice)
        self._command.content = _box(command(self._run, chosen) if chosen else "")
        self._button.disabled = not chosen
        self._answer.content = ""
        self._moved(choice)

    def _dragged(self) -> None:
        self._center.value = tuple(float(v) for v in self._gizmo.position)

    def _toggle(self) -> None:
        self._gizmo.position = tuple(self._center.value)
        self._gizmo.visible = self._handle.value

    def _restore(self) -> None:
        ball = self._scene.model.ball
        self._center.value, self._radius.value = tuple(ball.center), ball.radius
        for slider in self._lean:
            slider.value = 0.0
        self._toggle()

    def _write(self, remember: Callable[[list[str]], str]) -> None:
        self._answer.content = _box(remember(assignments(self._scene, self.choice)), code=False)


def command(run: str, chosen: Sequence[str]) -> str:
    """The command line that makes a run with these settings."""
    return " ".join([run, *(f"--set '{text}'" for text in chosen)])


def _box(text: str, *, code: bool = True) -> str:
    """A text that can be selected, as HTML; nothing for no text."""
    if not text:
        return ""
    inner = escape(printable(text))
    inner = (
        f"<code style='user-select:all;overflow-wrap:anywhere'>{inner}</code>" if code else inner
    )
    return f"<div style='padding:0 0.8em;font-size:0.85em'>{inner}</div>"
