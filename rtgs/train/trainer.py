"""One training loop for all methods: views, backward pass, checkpoints, progress, metrics. Knows no method by name."""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from rtgs.core.decisions import Decision
from rtgs.core.memory import hand_back
from rtgs.core.version import VERSION
from rtgs.native import core
from rtgs.native.threads import SERIAL_PIXELS, serial_torch, settled_threads
from rtgs.scenes.scene import Scene
from rtgs.train.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointRecord,
    RunSettings,
    canonical_json,
    check_resumable,
    digest,
    load_newest,
    save_checkpoint,
    scene_digest,
)
from rtgs.train.clock import Clock, ElapsedTime
from rtgs.train.guard import check_loss, diverged
from rtgs.train.held_out import HeldOutView, psnr_of
from rtgs.train.memory import peak_memory_mb, start_peak_memory
from rtgs.train.method import LossValue, Method, Mode, Stage, StepEvent
from rtgs.train.onlooker import Onlooker, TrainingStopped
from rtgs.train.progress import Progress, SilentProgress, StepReport
from rtgs.train.recording import History, Observer, Recorder, RunningAverages
from rtgs.train.resolution import GrowingViews
from rtgs.train.seeds import seed_for
from rtgs.train.settings import ScheduleSettings, WatchSettings
from rtgs.train.view_order import OrderState, ViewOrder
from rtgs.train.watch import Watch, look, why_idle

REPORT_EVERY = 10  # steps between looks at the PSNR of a training view
RECORD_EVERY = 50  # steps between batches of metrics
HAND_BACK_EVERY = 50  # steps between times at which freed memory goes back (docs/lab/threads.md, "Memory")


@dataclass(frozen=True)
class TrainSummary:
    """What a run of the trainer did."""

    steps: int  # done in all, resumed ones included
    seconds: float  # training time in all, resumed ones included
    cpu_seconds: float  # CPU time of it, all threads: the same on a busy machine
    seconds_per_step: float  # of this process
    peak_memory_mb: float  # largest resident set during this training (elsewhere than on Linux: of the process)
    surfels: int  # in all sets
    loss: float  # running average at the end
    psnr_train: float  # running average at the end, dB
    psnr_test: float | None  # mean over the test views, dB; None where the scene has none
    resumed_from: int | None  # step of the checkpoint this process went on from
    decisions: tuple[Decision, ...]


class Trainer:
    """Trains one stage of a method on a scene.

    With ``checkpoint_dir``, checkpoints go there and a run finds its way on from the newest of them, bit for bit as if
    it had not been interrupted (equal settings, scene, thread count, instruction set). The state at the end of the
    stage is the last checkpoint.

    Parameters
    ----------
    method : Method
        What is trained; :func:`rtgs.methods.create_method` makes it.
    scene : Scene
        Training views, pseudo views among them, and test views for the figures.
    seed : int
        Of the order of the views.
    stage : Stage, optional
        None: the method's first.
    views : callable, optional
        Asked once the stage has begun or gone on: the schedule that says when views are shrunk. It must follow from
        the method's settings and state, for checkpoints do not compare it. None: the method's schedule says so.
    progress : Progress, optional
        Who is told how far it is; None: nobody.
    recorder : Recorder, optional
        Who gets the metrics; None: nobody.
    checkpoint_dir : Path, optional
        None: no checkpoints.
    observer : Observer, optional
        Looks at the method after every step.
    watch : WatchSettings, optional
        When the test views are scored along the way, for the recorder; the clock stands still meanwhile. None: never.
    onlooker : Onlooker, optional
        Who looks at the method while it trains, and may ask it to end.
    spent : ElapsedTime, optional
        Training time that counts as this one's: of the models that the scene's pseudo views are of.
    """

    def __init__(
        self,
        method: Method,
        scene: Scene,
        *,
        seed: int,
        stage: Stage | None = None,
        views: Callable[[], ScheduleSettings] | None = None,
        progress: Progress | None = None,
        recorder: Recorder | None = None,
        checkpoint_dir: Path | None = None,
        observer: Observer | None = None,
        watch: WatchSettings | None = None,
        onlooker: Onlooker | None = None,
        spent: ElapsedTime | None = None,
    ) -> None:
        self.method = method
        self.scene = scene
        self.schedule = method.schedule
        self.stage = stage or method.stages[0]
        self.progress = progress or SilentProgress()
        self.recorder = recorder
        self.checkpoint_dir = checkpoint_dir
        self.observer = observer
        self.onlooker = onlooker
        self._idle = why_idle(watch, tested=bool(scene.test), recorded=recorder is not None)
        self._watch = Watch(watch) if watch is not None and watch.on and not self._idle else None
        self._views = views
        joined = self.stage.joined > 0
        self._photos = (*scene.train, *(scene.held if joined else ()), *scene.pseudo)
        self._growing = GrowingViews(self._photos, self.schedule)
        self._order = ViewOrder(len(self._photos), seed_for(seed, "joined views" if joined else "views"))
        self._averages = RunningAverages()
        self._held_out = HeldOutView(scene, self.schedule.total)
        self._seen: float | None = None  # its PSNR when it was last looked at
        self._step = self.stage.from_step
        self._elapsed_before = spent or ElapsedTime()
        self._clock = Clock()
        self._window: list[tuple[LossValue, ...]] = []
        self._seed = seed
        self._run = self._settings_of(self.stage)
        self._settings = canonical_json(self._run)
        self._scene_digest = scene_digest(scene)

    def run(self) -> TrainSummary:
        """Train until the end of the stage.

        Returns
        -------
        TrainSummary
            What was done, and how well it fits.

        Raises
        ------
        TrainingDiverged
            A loss or gradient is not finite; the last checkpoint is intact.
        CheckpointError
            ``checkpoint_dir`` holds checkpoints that cannot be used, or none of a stage that is to be gone on with.
        TrainingStopped
            The onlooker asked for the end; the present state is the last checkpoint.
        """
        start_peak_memory()
        resumed_from = self._resume()
        first = self._step
        if isinstance(self.recorder, History):
            self.recorder.forget_after(first)
        self._clock = Clock()
        if self._watch is not None:
            self._watch.due(first, self._elapsed_before.cpu)
        self.progress.start(self.stage.name, first, self.stage.until)
        try:
            self._announce(resumed_from)
            if first == self.stage.from_step:
                self._note(first, self.method.begin(self.stage))
            self._show_as_told()
            largest = max(view.camera.width * view.camera.height for view in self._photos)
            with serial_torch(largest <= SERIAL_PIXELS):
                while self._step < self.stage.until:
                    self._train_step()
                    self._between_steps()
        finally:
            self._flush_metrics()
            self.progress.close()
        elapsed = self._clock.elapsed()
        in_all = self._elapsed_before + elapsed
        return TrainSummary(
            steps=self._step,
            seconds=in_all.wall,
            cpu_seconds=in_all.cpu,
            seconds_per_step=elapsed.wall / max(self._step - first, 1),
            peak_memory_mb=peak_memory_mb(),
            surfels=self._surfels(),
            loss=self._averages.loss if self._averages.loss is not None else math.nan,
            psnr_train=self._averages.psnr if self._averages.psnr is not None else math.nan,
            psnr_test=self.evaluate() if self.scene.test else None,
            resumed_from=resumed_from,
            decisions=self._decisions,
        )

    def evaluate(self) -> float:
        """Mean PSNR over the test views at the present step, images clamped to [0, 1].

        Returns
        -------
        float
            In dB. The scene must have test views.
        """
        with torch.no_grad():
            values = [
                psnr_of(self.method.render(view.camera, self._step, Mode.EVALUATE, mask=view.mask).image, view.image)
                for view in self.scene.test
            ]
        return sum(values) / len(values)

    def checkpoint(self) -> Checkpoint:
        """The present state.

        Returns
        -------
        Checkpoint
            All that training needs to go on, for :func:`rtgs.train.checkpoint.save_checkpoint`.
        """
        order = self._order.state()
        tensors = {f"method.{name}": tensor for name, tensor in self.method.state().items()}
        tensors["views.permutation"] = order.permutation
        tensors["views.generator"] = order.generator
        return Checkpoint(self._record(order.position), tensors)

    def _train_step(self) -> None:
        """Render, loss, backward, Adam, density control: one step on one view."""
        step = self._step
        view = self._growing.at(self._order.next(), step)
        rendered = self.method.render(view.camera, step, Mode.TRAIN, mask=view.mask)
        terms = self.method.losses(rendered, view, step)
        loss = check_loss(terms, self.method, step, view.name)
        terms.total.backward()
        try:
            events = self.method.after_step(step, rendered.observations)
        except FloatingPointError as error:  # of Adam or of density control
            raise diverged(terms, self.method, step, view.name, cause=str(error)) from error
        self._note(step + 1, events)
        self._averages.add_loss(loss)
        if step % REPORT_EVERY == 0 and (rendered.drawn is None or bool(rendered.drawn.pixels.any())):
            self._averages.add_psnr(psnr_of(rendered.image.detach(), view.image, rendered.drawn))
        self._window.append(terms.terms)
        self._step = step + 1

    def _note(self, step: int, events: tuple[StepEvent, ...]) -> None:
        for event in events:
            self.progress.note(f"step {step}: {event.set_name}: {event.detail}")

    def _between_steps(self) -> None:
        """What happens every so many steps: progress, metrics, evaluation, checkpoint."""
        step, last = self._step, self._step == self.stage.until
        if self._held_out.is_due(step) and not last:  # the end measures all test views
            with self._off_the_clock():
                self._seen = self._held_out.psnr(self.method, step)
        if step % REPORT_EVERY == 0 or last:
            self.progress.advance(self._report())
        if step % RECORD_EVERY == 0:
            self._flush_metrics()
        if step % HAND_BACK_EVERY == 0:
            hand_back()
        every = self.schedule.evaluate_every
        if every and step % every == 0 and self.scene.test:
            with self._off_the_clock():
                psnr = self.evaluate()
            self.progress.note(f"step {step}: {psnr:.2f} dB on {len(self.scene.test)} test views")
            if self.recorder is not None:
                self.recorder.metrics({"test/psnr": psnr}, step)
        if self.observer is not None:
            with self._off_the_clock():
                self.observer.look(self.method, step)
        if self._watch is not None:
            self._look(self._watch, last)
        stopped = self.onlooker is not None and self._shown_to(self.onlooker)
        if self.checkpoint_dir is not None and (step % self.schedule.checkpoint_every == 0 or last or stopped):
            save_checkpoint(self.checkpoint_dir, self.checkpoint())
        if stopped and not last:
            raise TrainingStopped(step)

    def _shown_to(self, onlooker: Onlooker) -> bool:
        """Whether somebody who looked asks for the end; that time does not count, be it a pause."""
        with self._off_the_clock():
            return onlooker.look(self.method, self._step)

    def _look(self, watch: Watch, last: bool) -> None:
        """Score the test views where a mark was passed, and at the end of the stage; that time does not count."""
        cpu_seconds = (self._elapsed_before + self._clock.elapsed()).cpu
        if watch.due(self._step, cpu_seconds) or last:
            with self._off_the_clock():
                values = look(self.method, self.scene.test, self._step, cpu_seconds)
                assert self.recorder is not None
                self.recorder.metrics(values, self._step)

    @contextmanager
    def _off_the_clock(self) -> Iterator[None]:
        """What is done within is no time of training."""
        before = self._clock.elapsed()
        yield
        self._clock = self._clock.without(self._clock.elapsed() - before)

    def _flush_metrics(self) -> None:
        """Mean of every loss term since the last flush, and where training stands, to the recorder."""
        window, self._window = self._window, []
        if self.recorder is None or not window:
            return
        sums: dict[str, list[float]] = {}
        for terms in window:
            sums.setdefault("train/loss", []).append(sum(term.weight * term.value for term in terms))
            for term in terms:
                sums.setdefault(f"train/{term.name}", []).append(term.value)
        values = {name: sum(found) / len(found) for name, found in sums.items()}
        values["train/psnr"] = self._averages.psnr or 0.0
        for part in self.method.sets:
            values[f"surfels/{part.name}"] = float(len(part))
        self.recorder.metrics(values, self._step)

    def _announce(self, resumed_from: int | None) -> None:
        if resumed_from is not None:
            begins = (self.stage.from_step, self.stage.joined)  # with a checkpoint that another step made
            if resumed_from not in begins:
                self.progress.note(f"resumed from the checkpoint of step {resumed_from}")
            return
        for decision in self._decisions:
            self.progress.note(f"{decision.what}: {decision.why}")

    def _show_as_told(self) -> None:
        """Views as the stage has them, now that it has begun."""
        if self._views is None or (told := self._views()) == self.schedule:
            return
        self._growing = GrowingViews(self._photos, told, f"so the {self.stage.name} stage learns at less cost")
        if self._step == self.stage.from_step:
            for decision in self._growing.decisions:
                self.progress.note(f"{decision.what}: {decision.why}")

    def _resume(self) -> int | None:
        """Load the newest checkpoint, if there is one, and return its step."""
        place = self.checkpoint_dir
        checkpoint = None if place is None else load_newest(place, warn=self.progress.note)
        if checkpoint is None:
            if self.stage.joined:
                raise CheckpointError(
                    f"the {self.stage.name} stage is to go on from step {self.stage.joined}, and there is no "
                    f"checkpoint in {place}: train up to that step first"
                )
            return None
        record, tensors = checkpoint.record, checkpoint.tensors
        check_resumable(record, self._expected_record(record.step), self._run, warn=self.progress.note)
        prefix = "method."
        self.method.load({name[len(prefix) :]: t for name, t in tensors.items() if name.startswith(prefix)})
        if record.step != self.stage.joined:  # else its order is that of fewer views
            order = OrderState(tensors["views.permutation"], record.order_position, tensors["views.generator"])
            self._order.load(order)
        self._averages = RunningAverages(record.loss_average, record.psnr_average)
        self._step = record.step
        self._elapsed_before = ElapsedTime(record.elapsed, record.elapsed_cpu)
        return record.step

    def _settings_of(self, stage: Stage) -> RunSettings:
        return RunSettings(self.method.recipe(stage.name), self.method.schedule, self._seed)

    def _expected_record(self, step: int) -> CheckpointRecord:
        """What a checkpoint of ``step`` must agree with: at the stage's first step it is of the stage before."""
        names = [stage.name for stage in self.method.stages]
        before = names.index(self.stage.name) - 1 if self.stage.name in names else -1
        record = self._record(0)
        if step > self.stage.from_step or before < 0:
            return record
        settings = canonical_json(self._settings_of(self.method.stages[before]))
        return replace(record, settings=settings, settings_digest=digest(settings))

    def _record(self, order_position: int) -> CheckpointRecord:
        elapsed = self._elapsed_before + self._clock.elapsed()
        return CheckpointRecord(
            step=self._step,
            settings_digest=digest(self._settings),
            scene_digest=self._scene_digest,
            threads=settled_threads(),
            isa=core.isa(),
            versions=(("rtgs", VERSION), ("torch", torch.__version__), ("python", platform.python_version())),
            elapsed=elapsed.wall,
            elapsed_cpu=elapsed.cpu,
            loss_average=self._averages.loss,
            psnr_average=self._averages.psnr,
            order_position=order_position,
            settings=self._settings,
        )

    @property
    def _decisions(self) -> tuple[Decision, ...]:
        return (*self._growing.decisions, *self.method.decisions, *self._idle)

    def _surfels(self) -> int:
        return sum(len(part) for part in self.method.sets)

    def _report(self) -> StepReport:
        averages = self._averages
        return StepReport(self._step, averages.loss or 0.0, averages.psnr or 0.0, self._surfels(), self._seen)
