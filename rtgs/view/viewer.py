"""Between a model and the pages that show it: which picture is made when, and what a page asks of a training."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from rtgs.train.progress import Progress, SilentProgress, StepReport
from rtgs.view.budget import Budget, Speed
from rtgs.view.curves import Curves
from rtgs.view.mixing import Choice, kinds_of, lights_of, maps_of, pixels_of
from rtgs.view.seats import STILL, Seat, Seen, due

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.mesh.container import ObjectMesh
    from rtgs.scenes.scene import Scene
    from rtgs.train.method import Method

_NAP = 0.5  # seconds between looks at the pages while nothing is to be done
_TELL = 0.5  # seconds between two words about a training
_PLOT = 2.0  # seconds between two plots of its curves
_LEAST_SIDE = 512  # of the largest picture where the photos are smaller still, pixels
_UNCOVERED = 1e4  # depth where nothing hides what stands behind


class Page(Protocol):
    """What the viewer needs of its pages (:class:`rtgs.view.page.ViserPage`)."""

    @property
    def seats(self) -> Sequence[Seat]: ...

    @property
    def choice(self) -> Choice: ...

    share: float
    paused: bool
    stopped: bool
    woken: threading.Event

    def exhibit(self, scene: Scene, mesh: ObjectMesh | None) -> None:
        """Show what stands around the model: cameras, photos, masks, the mesh of the transparent object."""
        ...

    def offer(self, kinds: Sequence[str], lights: Sequence[str]) -> None:
        """The maps and layers that can be chosen."""
        ...

    def tell(self, text: str) -> None:
        """One paragraph about what is shown."""
        ...

    def plot(self, curves: Curves) -> None: ...


@dataclass(frozen=True)
class Exhibit:
    """A model as of a step, as the viewer looks at it.

    Attributes:
        maps: the maps of a camera for a choice.
        kinds: of :data:`rtgs.report.shown.SHOWN`, by the maps of a view.
        blend: in which space its layers add up.
        long_side: of the largest picture, pixels.
    """

    step: int
    maps: Callable[[Camera, Choice], Mapping[str, Tensor]]
    kinds: Callable[[Mapping[str, Tensor]], Sequence[str]]
    blend: str
    long_side: int


@dataclass
class Viewer:
    """Makes pictures between the steps of a training, in its thread, so that nothing of it changes.

    Implements :class:`rtgs.train.onlooker.Onlooker`.
    """

    page: Page
    long_side: int = 0  # of the largest picture; 0: of the photos
    curves: Curves = field(default_factory=Curves)

    def __post_init__(self) -> None:
        now = time.monotonic()
        self._budget, self._speed = Budget(now), Speed()
        self._told = self._plotted = 0.0
        self._side = _LEAST_SIDE
        self._title, self._total = "", 0
        self._terminal: Progress = SilentProgress()
        self._report: StepReport | None = None
        self._failed = False

    # ---- of a training

    def attend(self, scene: Scene, mesh: ObjectMesh | None, progress: Progress | None = None) -> None:
        """A stage begins; ``progress`` is where the terminal is told of a pause."""
        self._terminal = progress or SilentProgress()
        self._side = largest_side(scene, self.long_side)
        self.page.exhibit(scene, mesh)
        for seat in self.page.seats:
            seat.seen = None

    def look(self, method: Method, step: int) -> bool:
        """Between two steps: one picture where one is due and its time has come; waits while somebody pauses.

        True: somebody asks the training to end here.
        """
        page = self.page
        if page.stopped:
            return True
        if page.paused:
            self._wait(method, step)
        elif page.seats and not self._failed and self._budget.free(time.monotonic(), page.share):
            start = time.monotonic()
            self._try(self._make, self._exhibit(method, step))
            self._budget.spend(time.monotonic() - start)  # pictures of a pause take no time of the training
        return page.stopped

    def _try(self, work: Callable[[Exhibit], object], exhibit: Exhibit) -> None:
        """A picture that cannot be made ends no training; no other one is tried."""
        try:
            work(exhibit)
        except Exception as error:
            self._failed = True
            what = f"the viewer shows nothing more of this training: {type(error).__name__}: {error}"
            self._terminal.note(what)
            self.page.tell(what)

    def _wait(self, method: Method, step: int) -> None:
        self._terminal.note(f"paused in the viewer at step {step}")
        exhibit = self._exhibit(method, step)
        self._say(force=True)
        while self.page.paused and not self.page.stopped:
            if self._failed:
                self.page.woken.wait(_NAP)
                self.page.woken.clear()
            else:
                self._try(self.serve, exhibit)
                self._say()
        if not self.page.stopped:
            self._terminal.note("going on")

    def _exhibit(self, method: Method, step: int) -> Exhibit:
        optics = getattr(getattr(method, "settings", None), "optics", None)
        return Exhibit(
            step,
            lambda camera, choice: maps_of(method, camera, step, choice),
            lambda maps: kinds_of(method, maps),
            getattr(optics, "blend", "srgb"),
            self._side,
        )

    # ---- Progress

    def start(self, title: str, done: int, total: int) -> None:
        """A stage begins at step ``done``."""
        self._title, self._total, self._report = title, total, None

    def advance(self, report: StepReport) -> None:
        """Where training stands."""
        self._report = report
        self.curves.add(report)
        if self.page.seats and not self._failed:
            self._say()

    def note(self, text: str) -> None:
        """Lines are for the terminal."""

    def close(self) -> None:
        """The stage has ended."""
        self.page.tell(f"**{self._title}** has ended; what follows is not shown here.")

    def _say(self, force: bool = False) -> None:
        now = time.monotonic()
        if not force and now - self._told < _TELL:
            return
        self._told = now
        state = " **paused**" if self.page.paused else ""
        self.page.tell("  \n".join([f"**{self._title}**{self._standing()}{state}", *self._figures(), self.pace]))
        if force or now - self._plotted > _PLOT:
            self._plotted = now
            self.page.plot(self.curves)

    def _standing(self) -> str:
        return "" if self._report is None else f" step {self._report.step} of {self._total}"

    def _figures(self) -> list[str]:
        report = self._report
        if report is None:
            return []
        seen = "" if report.held_out is None else f", of a test view {report.held_out:.2f} dB"
        return [f"loss {report.loss:.4f}, PSNR {report.psnr:.2f} dB{seen}", f"{report.surfels:,} Gaussians"]

    @property
    def pace(self) -> str:
        """In words, how large pictures are and how long they take."""
        made = next((seat.seen for seat in self.page.seats if seat.seen is not None), None)
        rate = self._speed.pixels_per_second
        if made is None or not rate:
            return ""
        camera = made.camera
        return f"picture {camera.width}x{camera.height}, {made.pixels / rate:.2f} s"

    # ---- pictures

    def serve(self, exhibit: Exhibit) -> None:
        """One picture where one is due, else a short wait for somebody to ask for something."""
        if not self._make(exhibit):
            moving = any(time.monotonic() - seat.moved < STILL for seat in self.page.seats)
            self.page.woken.wait(STILL / 2 if moving else _NAP)
            self.page.woken.clear()

    def _make(self, exhibit: Exhibit) -> bool:
        """The picture that is due; False: none is."""
        choice = self.page.choice
        start = time.monotonic()
        found = due(self.page.seats, choice, exhibit.step, start, self._speed, exhibit.long_side)
        if found is None:
            return False
        seat, gaze = found.seat, found.seat.gaze
        seen = seat.seen
        if found.pixels or seen is None:
            camera = gaze.camera(found.pixels, exhibit.long_side)
            maps = exhibit.maps(camera, choice)
            self._speed.learn(camera.width * camera.height, time.monotonic() - start)
            self.page.offer(exhibit.kinds(maps), lights_of(maps))
            seat.seen = Seen(gaze, choice, exhibit.step, camera, maps)
        else:
            seat.seen = Seen(seen.gaze, choice, seen.step, seen.camera, seen.maps)
        seen = seat.seen
        depth = _hiding(seen.maps) if choice.depth else None
        draft = seen.pixels < gaze.full(exhibit.long_side) / 2
        seat.show(pixels_of(choice, seen.maps, seen.camera, exhibit.blend), depth, draft)
        return True


def _hiding(maps: Mapping[str, Tensor]):
    """(H, W) float32 z-depth of what is covered, far elsewhere; None of a view without depths."""
    if "depth" not in maps:
        return None
    depth = maps["depth"].detach().float()
    covered = (maps["alpha"] >= 0.5) & (depth > 0)
    return depth.masked_fill(~covered, _UNCOVERED).numpy()


def largest_side(scene: Scene, asked: int) -> int:
    """Of pictures, pixels: as asked; 0: of the photos that the scene is trained on, but no thumbnail."""
    photos = max(max(view.camera.width, view.camera.height) for view in (*scene.train, *scene.test))
    return asked or max(photos, _LEAST_SIDE)
