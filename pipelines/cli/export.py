"""``rtgs export RUN``: a trained model as a file for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.cli.threads import with_threads
from pipelines.cli.words import THREADS, Reader, place, read_words, some_of, whole

if TYPE_CHECKING:
    from pipelines.publishing.exported_run import ExportedRun
    from rtgs.export.formats import SplatFormat
    from rtgs.runs.shown import ShownRun

FORMATS = ("ply", "compressed_ply", "spz", "sog", "glb", "html")
PAGE = "html"
MOST_STEPS, MOST_SPLATS = 1_000_000, 100_000_000

HELP = """rtgs export [RUN] [key=value ...]     a run: a folder, a name in runs/; without one, the newest

  format=NAME[,NAME...]     default: ply
      ply             one set of Gaussians for every viewer; layers are baked into it, and what that loses is printed
      compressed_ply  the one set, packed to a quarter of the PLY; PlayCanvas, SuperSplat
      spz             the one set, packed to less than a fifth of the PLY; Niantic
      sog             the one set as pictures, for PlayCanvas; needs splat-transform (npm) on PATH
      glb             KHR_gaussian_splatting, and the glass as a mesh that lets light pass; glTF programs
      html            one page for any browser, phones too: the glass reflects and moves with the viewer
  steps=2000          of the fit of the one set; a model that is one set is written as it is
  splats=N            at most so many Gaussians (default: 1.5 times those of the model that are seen directly)
  out=FOLDER          default: exports/ in the run's folder
  threads=N root=FOLDER     root holds runs/ and store/"""


@dataclass(frozen=True)
class ExportWords:
    """The words of the command; None: not given."""

    run: str | None = None
    format: tuple[str, ...] = ("ply",)
    steps: int | None = None
    splats: int | None = None
    out: Path | None = None
    threads: int | None = None
    root: Path | None = None


def export(words: Sequence[str], root: Path) -> int:
    """The command; returns the exit code.

    Raises:
        RtgsError: a word that is not understood, no such run, a fit is asked for of a model that is one set, or
            something has to be installed first.
    """
    if words[:1] in (["-h"], ["--help"]):
        print(HELP)
        return 0
    from pipelines.publishing.exported_run import FOLDER, check_fit, export_run, has_glass
    from pipelines.steps.report import PAGE as REPORT
    from rtgs.export.bake import BakeSettings
    from rtgs.export.formats import splat_format
    from rtgs.report.files import link_files
    from rtgs.runs.shown import locate_run, open_run

    asked = parse_words(words)
    formats = [None if name == PAGE else splat_format(name) for name in asked.format]  # before anything is rendered
    folder = locate_run(asked.root or root, asked.run)
    with with_threads(asked.threads):
        run = open_run(folder)
        check_fit(run, asked.steps, asked.splats)
        settings = BakeSettings(asked.steps or BakeSettings.steps, asked.splats)
        print(f"{folder.name}: {', '.join(asked.format)}", flush=True)
        kinds = [(each is None or each.has_glass) and has_glass(run) for each in formats]
        made = {}
        for clear in sorted(set(kinds)):
            made[clear] = export_run(run, settings, asked.out or folder / FOLDER, clear=clear)
            print(made[clear].record.says(), flush=True)
        _write(run, [made[clear] for clear in kinds], formats)
    if (folder / REPORT).is_file():
        link_files(folder / REPORT)
    return 0


def _write(run: ShownRun, sets: Sequence[ExportedRun], formats: Sequence[SplatFormat | None]) -> None:
    """Write each format, read it back, and print what it is worth."""
    print(f"\n{'format':<15}{'size':>10}{'Gaussians':>12}{'of the set':>13}{'of the layers':>15}   file")
    for found, each in zip(sets, formats):
        if each is None:
            _write_page(run, found)
            continue
        path = found.ply.with_name(run.folder.name + each.suffix)
        if path != found.ply:
            each.write(path, found.export(run))
        back = each.read(path)
        of_set, of_layers = found.psnr(run, back)
        same = "the same" if of_set >= 99.995 else f"{of_set:.2f} dB"
        size = f"{path.stat().st_size / 1e6:.2f} MB"
        print(f"{each.name:<15}{size:>10}{len(back):>12,}{same:>13}{f'{of_layers:.2f} dB':>15}   {path}", flush=True)


def _write_page(run: ShownRun, found: ExportedRun) -> None:
    """The page holds the set as spz; what it looks like is the browser's work, so no figure stands here."""
    from pipelines.publishing.exported_page import write_run_page

    path = found.ply.with_name(f"{run.folder.name}.{PAGE}")
    write_run_page(run, found, path)
    size = f"{path.stat().st_size / 1e6:.2f} MB"
    print(f"{PAGE:<15}{size:>10}{len(found.splats):>12,}{'-':>13}{'-':>15}   {path}", flush=True)


def parse_words(words: Sequence[str]) -> ExportWords:
    """The words of ``rtgs export``.

    Raises:
        RtgsError: names the word and what may stand there.
    """
    return ExportWords(
        **read_words("rtgs export", words, _READERS, options="is no word of it: write key=value", help=HELP)
    )


_READERS: dict[str, Reader] = {
    "format": some_of(FORMATS),
    "steps": whole(1, MOST_STEPS),
    "splats": whole(1, MOST_SPLATS),
    "out": place,
    "threads": THREADS,
    "root": place,
}
