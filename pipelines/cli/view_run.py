"""``rtgs view RUN``: a trained model in the browser, its layers as switches."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.cli.termination import Terminated
from pipelines.cli.words import THREADS, Reader, place, read_words, whole
from rtgs.view.settings import HIGHEST_PORT, LARGEST_SIDE, ViewerSettings

if TYPE_CHECKING:
    from rtgs.config.schema import RunConfig
    from rtgs.runs.shown import ShownRun
    from rtgs.view.page import ViserPage
    from rtgs.view.viewer import Viewer
    from rtgs.workflow import Plan, PlannedStep

log = logging.getLogger("rtgs")

HELP = """rtgs view [RUN] [key=value ...]       a run: a folder, a name in runs/; without one, the newest

  host=127.0.0.1 port=8080              where the page is; other addresses: whoever reaches them sees the photos
  long_side=N                           pixels of the largest picture (default: of the photos, 512 at least)
  threads=N root=FOLDER                 root holds runs/ and store/

While it trains: rtgs run ... view=true (docs/view.md). Needs viser: pip install -e '.[viewer]' in the clone."""


@dataclass(frozen=True)
class ViewWords:
    """The words of the command; None: not given."""

    run: str | None = None
    host: str | None = None
    port: int | None = None
    long_side: int | None = None
    threads: int | None = None
    root: Path | None = None

    @property
    def settings(self) -> ViewerSettings:
        """Of the page.

        Raises:
            RtgsError: a value is out of range.
        """
        given = {name: getattr(self, name) for name in ("host", "port", "long_side")}
        return ViewerSettings(**{name: value for name, value in given.items() if value is not None})


def view_run(words: Sequence[str], root: Path) -> int:
    """The command: until Ctrl-C; returns the exit code.

    Raises:
        RtgsError: a word that is not understood, no such run, viser is not there, the address cannot be had.
    """
    from pipelines.cli.threads import with_threads
    from rtgs.runs.shown import locate_run, open_run
    from rtgs.view.page import open_page
    from rtgs.view.server import need_viser

    asked = parse_words(words)
    settings = asked.settings
    need_viser()
    folder = locate_run(asked.root or root, asked.run)
    with with_threads(asked.threads):
        run = open_run(folder)
        with open_page(settings, f"rtgs: {folder.name}", training=False) as page:
            print(f"{folder.name}: {page.address}  (Ctrl-C ends it)", flush=True)
            try:
                show(run, page, settings.long_side)
            except Terminated:
                raise
            except KeyboardInterrupt:
                return 0
    return 0


def show(run: ShownRun, page: ViserPage, long_side: int) -> None:
    """Make pictures as the pages ask for them; returns when the page is stopped."""
    from rtgs.view.curves import Curves
    from rtgs.view.mixing import kinds_of
    from rtgs.view.viewer import Exhibit, Viewer, largest_side

    viewer = Viewer(page, long_side)
    viewer.attend(run.scene, run.object_mesh)
    settings = run.method.settings
    exhibit = Exhibit(
        run.step,
        lambda camera, choice: run.maps(camera),
        lambda maps: kinds_of(run.method, maps),
        settings.optics.blend,
        largest_side(run.scene, long_side),
    )
    page.plot(Curves.of_history(run.history))
    while not page.stopped:
        viewer.serve(exhibit)
        page.tell(f"**{run.folder.name}**  \n{run.method.name}, step {run.step}  \n{viewer.pace}")


@contextmanager
def viewed(config: RunConfig, plan: Plan) -> Iterator[Viewer | None]:
    """The page of a run with ``view=true``, for as long as the block runs; None: nobody asked, or nothing trains.

    Raises:
        RtgsError: viser is not there, or the address cannot be had.
    """
    if not config.view:
        yield None
        return
    if not any(_trains(planned) for planned in plan):
        log.info("view=true: nothing is left to train; `rtgs view %s` shows the model", config.name)
        yield None
        return
    from rtgs.view.page import open_page
    from rtgs.view.viewer import Viewer

    with open_page(config.viewer, f"rtgs: {config.name}", training=True) as page:
        log.info("the training in a browser: %s", page.address)
        yield Viewer(page, config.viewer.long_side)


def _trains(planned: PlannedStep) -> bool:
    """Whether a step is a training that will run here; one of the remote store is fetched."""
    training = planned.step.needs_of.startswith("train_")
    return training and not planned.hit and not planned.remote


def parse_words(words: Sequence[str]) -> ViewWords:
    """The words of ``rtgs view``.

    Raises:
        RtgsError: names the word and what may stand there.
    """
    return ViewWords(**read_words("rtgs view", words, _READERS, options="is no word of it: write key=value", help=HELP))


_READERS: dict[str, Reader] = {
    "host": str,
    "port": whole(0, HIGHEST_PORT),
    "long_side": whole(0, LARGEST_SIDE),
    "threads": THREADS,
    "root": place,
}
