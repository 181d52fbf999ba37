"""The page in the browser: a viser server with the model behind, things of the capture before it, and its switches."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from rtgs.view.around import Surroundings
from rtgs.view.curves import Curves
from rtgs.view.mixing import FINAL, Choice
from rtgs.view.seats import Gaze, Seat, Seen
from rtgs.view.server import address, serving

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]  (an extra)

    from rtgs.mesh.container import ObjectMesh
    from rtgs.scenes.scene import Scene
    from rtgs.view.settings import ViewerSettings

MOST_WEIGHT = 2.0  # of a layer's slider
_QUALITY = 90  # JPEG, of a picture that stands
_DRAFT_QUALITY = 70


class ViserSeat:
    """One open page."""

    def __init__(self, client: viser.ClientHandle, woken: threading.Event) -> None:
        self.client = client
        self.moved = 0.0
        self.seen: Seen | None = None
        self.gaze = Gaze((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0, 0)
        self._woken = woken
        self._aim(client.camera)
        client.camera.on_update(self._look)

    async def _look(self, camera: viser.CameraHandle) -> None:
        self._aim(camera)

    def _aim(self, camera: viser.CameraHandle) -> None:
        """Its camera is somewhere else."""
        w, x, y, z = (float(each) for each in camera.wxyz)
        first, second, third = (float(each) for each in camera.position)
        size = (int(camera.image_width), int(camera.image_height))
        gaze = Gaze((w, x, y, z), (first, second, third), float(camera.fov), *size)
        if gaze != self.gaze:
            self.gaze, self.moved = gaze, time.monotonic()
            self._woken.set()

    def show(self, pixels: np.ndarray, depth: np.ndarray | None, draft: bool) -> None:
        """:meth:`rtgs.view.seats.Seat.show`."""
        quality = _DRAFT_QUALITY if draft else _QUALITY
        self.client.scene.set_background_image(pixels, "jpeg", jpeg_quality=quality, depth=depth)
        self.client.flush()


class ViserPage:
    """:class:`rtgs.view.viewer.Page` in browsers.

    Parameters
    ----------
    server : viser.ViserServer
        Of :func:`rtgs.view.server.serving`.
    share : float
        Of the time of a training, to begin with.
    training : bool
        Whether there is anything to pause and to stop.
    """

    def __init__(self, server: viser.ViserServer, share: float, *, training: bool) -> None:
        self.server = server
        self.share = share
        self.paused = self.stopped = False
        self.woken = threading.Event()
        self._seats: dict[int, ViserSeat] = {}
        self._kinds: tuple[str, ...] = ()
        self._weights: dict[str, tuple[Any, Any]] = {}  # switch and slider by layer
        self._plots: list[Any] = []
        self._choice = Choice()
        self._build(training)
        self.around = Surroundings(server, self._chosen)
        self._curves = server.gui.add_folder("Curves", visible=False)
        server.on_client_connect(self._join)
        server.on_client_disconnect(self._leave)

    @property
    def address(self) -> str:
        """What to open."""
        return address(self.server)

    @property
    def seats(self) -> Sequence[Seat]:
        """Of the pages that are open now."""
        return list(self._seats.values())

    @property
    def choice(self) -> Choice:
        """What is chosen, for all pages."""
        return self._choice

    def exhibit(self, scene: Scene, mesh: ObjectMesh | None) -> None:
        """:meth:`rtgs.view.viewer.Page.exhibit`."""
        self.around.show(scene, mesh)

    def tell(self, text: str) -> None:
        """:meth:`rtgs.view.viewer.Page.tell`."""
        if self._state.content != text:
            self._state.content = text

    def offer(self, kinds: Sequence[str], lights: Sequence[str]) -> None:
        """:meth:`rtgs.view.viewer.Page.offer`; a method gains layers from stage to stage."""
        if tuple(kinds) != self._kinds:
            self._kinds = tuple(kinds)
            chosen = self._shown.value if self._shown.value in kinds else FINAL
            self._shown.options = self._kinds
            self._shown.value = chosen
        for name in lights:
            if name not in self._weights:
                self._weights[name] = self._layer(name)
        self._layers.visible = bool(self._weights)

    def plot(self, curves: Curves) -> None:
        """:meth:`rtgs.view.viewer.Page.plot`."""
        if len(curves) < 2:
            return
        steps, loss, psnr, held_out = curves.arrays()
        pictures = [(steps, loss), (steps, psnr, held_out)]
        if self._plots:
            for plot, data in zip(self._plots, pictures, strict=True):
                plot.data = data
            return
        with self._curves:
            self._plots = [_plot(self.server, *each) for each in zip(pictures, _SERIES, _TITLES, strict=True)]
        self._curves.visible = True

    # ---- what it is made of

    def _build(self, training: bool) -> None:
        gui = self.server.gui
        self._state = gui.add_markdown("loading")
        if training:
            self._build_training(gui)
        options: tuple[str, ...] = (FINAL,)
        self._shown: Any = gui.add_dropdown("show", options, hint="the image, or one map of it")
        self._shown.on_update(self._chosen)
        self._layers = gui.add_folder("Layers", visible=False)

    def _build_training(self, gui: viser.GuiApi) -> None:
        self._pause = gui.add_button("Pause", hint="the training waits; pictures take all of the time")
        stop = gui.add_button("Stop after a checkpoint", hint="the same command goes on from there")
        share = gui.add_slider("time for pictures, %", 1, 100, 1, max(1, round(100 * self.share)))

        @self._pause.on_click
        def _(_event: object) -> None:
            self.paused = not self.paused
            self._pause.label = "Go on" if self.paused else "Pause"
            self.woken.set()

        @stop.on_click
        def _(_event: object) -> None:
            self.stopped = True
            stop.disabled = self._pause.disabled = True
            self.tell("**stopping** after a checkpoint; the same command goes on from there")
            self.woken.set()

        @share.on_update
        def _(_event: object) -> None:
            self.share = share.value / 100

    def _layer(self, name: str) -> tuple[Any, Any]:
        """A switch and a slider."""
        with self._layers:
            switch = self.server.gui.add_checkbox(name, True)
            slider = self.server.gui.add_slider(f"{name}, weight", 0.0, MOST_WEIGHT, 0.05, 1.0)
        switch.on_update(self._chosen)
        slider.on_update(self._chosen)
        return switch, slider

    def _chosen(self, _event: object = None) -> None:
        """Something was switched."""
        weights = (
            (name, slider.value if switch.value else 0.0) for name, (switch, slider) in list(self._weights.items())
        )
        told = tuple((name, float(weight)) for name, weight in weights if weight != 1)
        self._choice = Choice(self._shown.value, told, self.around.visible)
        self.woken.set()

    async def _join(self, client: viser.ClientHandle) -> None:
        self._seats[client.client_id] = ViserSeat(client, self.woken)
        self.woken.set()

    async def _leave(self, client: viser.ClientHandle) -> None:
        self._seats.pop(client.client_id, None)


_TITLES = ("loss", "PSNR, dB")
_SERIES = ((("loss", "#e6a23c"),), (("training views", "#67a9cf"), ("test views", "#ef8a62")))


def _plot(
    server: viser.ViserServer, data: tuple[np.ndarray, ...], named: tuple[tuple[str, str], ...], title: str
) -> Any:
    from viser import uplot  # pyright: ignore[reportMissingImports]

    series = (uplot.Series(label="step"), *(uplot.Series(label=n, stroke=c, width=2, spanGaps=True) for n, c in named))
    return server.gui.add_uplot(
        data, series, title=title, scales={"x": uplot.Scale(time=False)}, legend=uplot.Legend(show=True), aspect=2.0
    )


@contextmanager
def open_page(settings: ViewerSettings, label: str, *, training: bool) -> Iterator[ViserPage]:
    """A page while the block runs.

    Raises:
        RtgsError: viser is not there, or the address is none of this machine.
    """
    with serving(settings, label) as server:
        yield ViserPage(server, settings.share, training=training)
