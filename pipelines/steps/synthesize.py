"""``rtgs run synthesize``: described scenes become path-traced captures with known truth, each a cached step."""

from __future__ import annotations

import logging
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from rtgs.core.errors import RtgsError
from rtgs.scenes.synthetic.settings import CaptureSettings
from rtgs.workflow import NOT_IN_RECIPE, Step, StepContext, StepKind

if TYPE_CHECKING:
    from rtgs.scenes.synthetic.description import SceneDescription

HELP = """rtgs run synthesize scene=NAME[,NAME...]|all|FILE.toml [key=value ...]

Path-traces described scenes into COLMAP captures with masks, normals and truth; needs the extra 'synthetic'.
A finished capture is kept in the store; a killed run goes on with the views it lacks.
"""
_BAR_STEPS = 1000
_LINE_EVERY = 10.0  # seconds between lines where there is no terminal

log = logging.getLogger("rtgs")


@dataclass(frozen=True)
class SynthesizeParams:
    """What a synthetic capture depends on."""

    scene: str
    description: str
    """SHA-256 of the scene's description (:func:`rtgs.scenes.synthetic.capture.description_digest`)."""
    settings: CaptureSettings
    file: str = field(metadata=NOT_IN_RECIPE)
    """The scene file."""
    variant: str | None = field(default=None, metadata=NOT_IN_RECIPE)
    """Of Mitsuba; None: the fastest here."""


def synthesize(params: SynthesizeParams, context: StepContext) -> None:
    """Write the capture; finished views are kept in the partial folder until all are there."""
    from rtgs.scenes.synthetic.capture import write_capture
    from rtgs.scenes.synthetic.description import read_description
    from rtgs.scenes.synthetic.variants import choose_variant

    variant, why = (params.variant, "as asked for") if params.variant else choose_variant()
    context.log.info("%s: rendered by Mitsuba's %s, %s", params.scene, variant, why)
    display = display_for()
    try:
        record = write_capture(
            read_description(Path(params.file)),
            context.out,
            context.partial,
            params.settings,
            variant=variant,
            progress=lambda name, share: display.update(f"{params.scene} {name}", share),
        )
    finally:
        display.close()
    numbers = {"noise_psnr": record.noise_psnr, "seconds": record.seconds, "points": float(record.points)}
    context.tracker.metrics(numbers)
    context.log.info(
        "%s: %d views of %dx%d, test images %.1f dB from converged (worst %.1f)",
        record.name, record.views, record.width, record.height, record.noise_psnr, record.noise_psnr_worst,
    )  # fmt: skip


STEP = StepKind("synthesize", 2, synthesize)


def synthesize_step(description: SceneDescription, file: Path, settings: CaptureSettings, variant: str | None) -> Step:
    """The step that makes one capture."""
    from rtgs.scenes.synthetic.capture import description_digest

    digest = description_digest(description)
    return STEP.step(SynthesizeParams(description.name, digest, settings, str(file), variant))


def run_synthesize(words: Sequence[str]) -> None:
    """The command line: compose, make what the store lacks, say where it is.

    Raises:
        RtgsError: no scene named, an unknown one, a value out of range.
        StepFailed: a capture could not be made.
    """
    from rtgs.config.synthesize import compose_synthesize
    from rtgs.scenes.synthetic.description import list_scenes, read_description
    from rtgs.workflow import InlineExecutor, Store, make_plan

    if not words or {"-h", "--help"} & set(words):
        print(f"{HELP}\nscenes: {', '.join(list_scenes())}\n\n{_keys()}")
        return
    files = scene_files([word for word in words if word.startswith("scene=")])
    config = compose_synthesize([word for word in words if not word.startswith("scene=")])
    places = {file.stem: Path(config.output) / file.stem for file in files} if config.output is not None else {}
    for place in places.values():
        _check_replaceable(place)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    steps = [synthesize_step(read_description(file), file, config.capture, config.variant) for file in files]
    store = Store(Path(config.paths.root) / "store")
    for result in InlineExecutor(store).execute(make_plan(steps, store)):
        name = result.step.params.scene
        place = places.get(name, result.folder)
        if name in places:
            export(result.folder, place)
        print(f"{name}: {place}\n  rtgs run scene.path={place}")


def scene_files(words: Sequence[str]) -> list[Path]:
    """The scene files that ``scene=`` names: names separated by commas, ``all``, or paths of TOML files.

    Raises:
        RtgsError: none, or an unknown one; lists those there are.
    """
    from rtgs.scenes.synthetic.description import SCENES, list_scenes

    known = list_scenes()
    names = [name for word in words for name in word.removeprefix("scene=").strip("'\"").split(",") if name]
    if not names:
        raise RtgsError(f"synthesize: name a scene, scene=NAME, scene=all or scene=FILE.toml; {_known(known)}")
    files = []
    for name in known if names == ["all"] else names:
        file = Path(name).expanduser() if name.endswith(".toml") else SCENES / f"{name}.toml"
        if not file.is_file():
            raise RtgsError(f"synthesize: there is no scene {name!r}; {_known(known)}, and any TOML file by its path")
        files.append(file)
    return files


def _known(names: list[str]) -> str:
    return f"rtgs describes {', '.join(names)}"


def _keys() -> str:
    from omegaconf import OmegaConf

    from rtgs.config.schema import open_schema
    from rtgs.config.synthesize import SynthesizeConfig

    return OmegaConf.to_yaml(OmegaConf.structured(open_schema(SynthesizeConfig)))


def export(artifact: Path, place: Path) -> None:
    """Copy a capture out of the store; an older synthetic capture there is replaced as a whole.

    Raises:
        RtgsError: something else is there.
        OSError: a file cannot be written (disk full); what was there stays.
    """
    from rtgs.scenes.synthetic.capture import copy_folder
    from rtgs.workflow.manifest import NAME

    _check_replaceable(place)
    place.parent.mkdir(parents=True, exist_ok=True)
    fresh = place.with_name(f"{place.name}.tmp")
    shutil.rmtree(fresh, ignore_errors=True)
    try:
        copy_folder(artifact, fresh, without=NAME)
    except OSError:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    shutil.rmtree(place, ignore_errors=True)
    fresh.rename(place)


def _check_replaceable(place: Path) -> None:
    from rtgs.scenes.synthetic.record import CAPTURE_RECORD

    if place.exists() and not (place / CAPTURE_RECORD).is_file():
        raise RtgsError(f"synthesize: {place} is there and is no synthetic capture: give another output folder")


class Display(Protocol):
    """Shows how far a capture is."""

    def update(self, what: str, share: float) -> None: ...

    def close(self) -> None: ...


class BarDisplay:
    """A bar with remaining time, on a terminal."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
        from rich.progress import TimeRemainingColumn as Remaining

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            Remaining(),
        )
        self._bar = Progress(*columns, console=Console(file=sys.stderr), speed_estimate_period=120)
        self._task = None

    def update(self, what: str, share: float) -> None:
        if self._task is None:
            self._bar.start()
            earlier = round(_BAR_STEPS * share)  # views done earlier are no speed
            self._task = self._bar.add_task(what, total=_BAR_STEPS, completed=earlier)
        self._bar.update(self._task, description=what, completed=_BAR_STEPS * share)

    def close(self) -> None:
        self._bar.stop()


class LineDisplay:
    """A line now and then, where there is no terminal."""

    def __init__(self) -> None:
        self._began: tuple[float, float] | None = None
        self._shown = 0.0

    def update(self, what: str, share: float) -> None:
        now = time.monotonic()
        self._began = self._began or (now, share)
        if now - self._shown < _LINE_EVERY and share < 1:
            return
        self._shown = now
        start, first = self._began
        left = (1 - share) * (now - start) / (share - first) if share > first else 0.0
        ending = f", {left / 60:.1f} min left" if left else ""
        print(f"{what}: {share:.0%}{ending}", file=sys.stderr, flush=True)

    def close(self) -> None: ...


def display_for() -> Display:
    """A bar where standard error is a terminal, lines elsewhere."""
    return BarDisplay() if sys.stderr.isatty() else LineDisplay()
