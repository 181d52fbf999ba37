"""What each piece of knowledge about a transparent object is worth: from its true surface down to the paper's own way.

``python -m lab.glass_ladder [--scenes ball_statue tall_bottle] [--rungs GROUP|NAME ...] [--preset quick]``

Every rung is a run of the pipeline (`rtgs run`) on a path-traced scene; what rungs share is trained once, and what the
store holds is not run again: stopped at any time, the same command goes on. `--size small`, the default, is the preset
at 128x96 pixels and half its steps, every start of a stage, interval and cap in proportion (SMALL); `--size preset`
leaves it alone. Every eighth training view is held out and judged beside the test views: choose by those, the test
views are only reported. *Bright* pixels are masked pixels of the test views (training views have no truth) whose true
reflected layer (sRGB encoded, mean of the channels) is above the view's 90th percentile within its mask. Depth and
normal: share of the test views' masked pixels within 3 % and 15 degrees of the true first surface, where the third
stage begins and of the final pictures. Loss: test views, dB below the first rung of the same scene and seed, in the
mask and on bright pixels; +- over the seeds. A Markdown table is written as it grows; last line: a JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.common.machine import machine
from benchmarks.quality.captures import over_seeds
from lab.glass_rungs import GROUPS, LEARNED, RUNGS, SMALL, Setting
from lab.specular_choices import HELD_OUT

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.config.schema import RunConfig
    from rtgs.scenes.scene import View

BRIGHT = 0.9  # quantile of the true reflected layer in the mask


@dataclass(frozen=True)
class Measured:
    """What one rung gave; None: not known for it."""

    psnr_held_out: float
    masked_held_out: float
    psnr: float
    ssim: float
    psnr_masked: float
    ssim_masked: float
    psnr_bright: float
    depth_before: float | None
    depth_after: float
    normal_before: float | None
    normal_after: float
    silhouette_iou: float | None
    seconds: float | None  # CPU, of the third stage


COLUMNS = (
    *("scene", "rung", "held out", "in the mask", "PSNR", "SSIM", "in the mask", "SSIM", "bright"),
    *("depth before", "after", "normal before", "after", "IoU", "CPU s", "loss in the mask", "bright"),
)
DIGITS = (2, 2, 2, 3, 2, 3, 2, 2, 2, 2, 2, 3, 0)  # of the fields of Measured


def prepare(scene: str, arguments: argparse.Namespace) -> Setting:
    """Write the split and the true container of an embedded scene, world frame."""
    from rtgs.mesh.score import container_mesh
    from rtgs.mesh.triangles import write_mesh_ply
    from rtgs.scenes.importers.registry import read_capture
    from rtgs.scenes.splits import choose_split

    settings = base_config(scene, arguments).scene
    capture = read_capture(settings)
    split = choose_split(capture, sorted(view.name for view in capture.views), settings)
    judged = split.train[HELD_OUT // 2 :: HELD_OUT]
    mesh = container_mesh(settings.name)
    if mesh is None:
        raise SystemExit(f"scene {scene} is no path-traced scene with something transparent: there is no ladder for it")
    arguments.root.mkdir(parents=True, exist_ok=True)
    files = [arguments.root.resolve() / f"{scene}-{name}" for name in ("split.json", "container.ply")]
    kept = [name for name in split.train if name not in judged]
    files[0].write_text(json.dumps({"train": kept, "test": [*judged, *split.test]}), encoding="utf-8")
    write_mesh_ply(files[1], mesh)
    return Setting(scene, files[0], files[1], judged)


def base_config(scene: str, arguments: argparse.Namespace) -> RunConfig:
    from rtgs.config.compose import compose

    return compose([f"scene={scene}", "method=rtgs", f"preset={arguments.preset}", *sized(arguments)])[0]


def sized(arguments: argparse.Namespace) -> list[str]:
    """The words beside scene, method, preset and seed."""
    return [*LEARNED, *(SMALL if arguments.size == "small" else ()), *arguments.set]


def run(name: str, setting: Setting, arguments: argparse.Namespace, seed: int) -> Measured | str:
    """Run the rung, or find it done; a string is why it failed."""
    rung = RUNGS[name]
    words = [f"scene={setting.scene}", f"method={rung.method}", f"preset={arguments.preset}", f"seed={seed}"]
    words += [f"scene.split_file={setting.split}", "evaluation.lpips=false", *sized(arguments)]
    words += rung.words(setting, base_config(setting.scene, arguments))
    words += [f"name={setting.scene}-{name}-{seed}", f"threads={arguments.threads}", "tracking=off"]
    done = subprocess.run(
        [sys.executable, "-m", "pipelines.run", *words, f"paths.root={arguments.root}"],
        env=os.environ | {"OMP_NUM_THREADS": str(arguments.threads)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["no message"])[-1]
    return read(arguments.root, f"{setting.scene}-{name}-{seed}", setting.held_out)


def read(root: Path, name: str, held_out: Sequence[str]) -> Measured:
    """The figures of a finished run."""
    folder = root / "runs" / name
    steps = json.loads((folder / "run.json").read_text(encoding="utf-8"))["steps"]
    places = {step: root / "store" / step / key[:2] / key for step, key in steps.items()}
    rows = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["views"]

    def mean(metric: str, *, judged: bool) -> float:
        return statistics.fmean(row["values"][metric] for row in rows if (row["view"] in held_out) == judged)

    before: dict[str, float | None] = {}
    seconds = None
    if third := places.get("train_transmittance"):
        before = json.loads((third / "boundary.json").read_text(encoding="utf-8"))["before"]
        spent = [_summary(place)["cpu_seconds"] for place in (third, places["train_reflection"])]
        seconds = spent[0] - spent[1]
    figures: list[Any] = [
        mean("psnr", judged=True),
        mean("psnr_masked", judged=True),
        *(mean(metric, judged=False) for metric in ("psnr", "ssim", "psnr_masked", "ssim_masked")),
        bright_psnr(places),
        before.get("depth_share"),
        mean("depth_share_masked", judged=False),
        before.get("normal_share"),
        mean("normal_share_masked", judged=False),
        before.get("silhouette_iou"),
        seconds,
    ]
    return Measured(*figures)


def _summary(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


def bright_psnr(places: dict[str, Path]) -> float:
    """Mean PSNR over the bright pixels of the views with truth."""
    from rtgs.evaluate.metrics import psnr
    from rtgs.runs.views import read_render
    from rtgs.scenes.canonical import read_scene

    scene = read_scene(places["import_scene"])
    views = [view for view in scene.test if view.truth is not None and view.mask is not None and view.mask.any()]
    images = (read_render(places["render"], view.name)["image"] for view in views)
    pairs = zip(images, views, strict=True)
    return statistics.fmean(float(psnr(image, view.image, mask=bright_pixels(view))) for image, view in pairs)


def bright_pixels(view: View) -> Tensor:
    """(H, W) bool: masked pixels whose true reflection is among the view's brightest."""
    from rtgs.evaluate.layers import encoded

    assert view.truth is not None
    assert view.mask is not None
    light = encoded(view.truth.reflected).mean(0)
    return view.mask & (light >= light[view.mask].quantile(BRIGHT))


BySeed = Mapping[int, Measured]


def losses(found: BySeed, first: BySeed) -> dict[str, list[float]]:
    """dB below the first rung, one value per seed that both have; over the same views, so paired."""
    both = [(first[seed], found[seed]) for seed in found if seed in first]
    masked = [theirs.psnr_masked - ours.psnr_masked for theirs, ours in both]
    return {"masked": masked, "bright": [theirs.psnr_bright - ours.psnr_bright for theirs, ours in both]}


def row(scene: str, name: str, found: BySeed, first: BySeed) -> list[str]:
    """One line of the table."""

    def cell(values: Sequence[float | None], digits: int) -> str:
        known = [value for value in values if value is not None]
        return over_seeds(known, digits) if known else "-"

    fields = zip(*(asdict(one).values() for one in found.values()), strict=True)
    cells = [cell(values, digits) for values, digits in zip(fields, DIGITS, strict=True)]
    return [scene, RUNGS[name].what, *cells, *(cell(values, 2) for values in losses(found, first).values())]


def figures_of(scene: str, name: str, found: BySeed, first: BySeed) -> dict[str, Any]:
    """One line of the table: means over the seeds, every seed's own, and the losses."""
    runs = [asdict(one) for one in found.values()]
    means = {}
    for key in runs[0]:
        known = [one[key] for one in runs if one[key] is not None]
        means[key] = statistics.fmean(known) if known else None
    return {"scene": scene, "rung": name, **means, "seeds": list(found), "runs": runs, "loss": losses(found, first)}


def table(rows: Sequence[Sequence[str]]) -> str:
    """The rows as Markdown."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (COLUMNS, ["---"] * len(COLUMNS), *rows)) + "\n"


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """All rungs, the table printed and written as it grows; the figures."""
    rows, figures, failures = [], [], []
    for scene in arguments.scenes:
        setting, first = prepare(scene, arguments), {}
        for name in named(arguments.rungs):
            found: dict[int, Measured] = {}
            for seed in arguments.seeds:
                outcome = run(name, setting, arguments, seed)
                if isinstance(outcome, str):
                    failures.append(f"{scene}, {name}, seed {seed}: {outcome}")
                    print(failures[-1], flush=True)
                else:
                    found[seed] = outcome
            if found:
                first = first or found
                rows.append(row(scene, name, found, first))
                figures.append(figures_of(scene, name, found, first))
                print("  ".join(rows[-1]), flush=True)
            write(arguments, rows, failures)
    print(f"\n{table(rows)}", flush=True)
    return {"machine": machine(), "preset": arguments.preset, "figures": figures, "failures": failures}


def named(words: Sequence[str]) -> list[str]:
    """The rungs of groups and names, each once, in order."""
    return list(dict.fromkeys(name for word in words for name in GROUPS.get(word, (word,))))


def write(arguments: argparse.Namespace, rows: Sequence[Sequence[str]], failures: Sequence[str]) -> None:
    """The table so far, with the command that makes it."""
    words = f"--preset {arguments.preset} --size {arguments.size} --scenes {' '.join(arguments.scenes)} "
    words += f"--rungs {' '.join(arguments.rungs)} --seeds {' '.join(map(str, arguments.seeds))}"
    words += f" --set {' '.join(arguments.set)}" if arguments.set else ""
    text = f"`python -m lab.glass_ladder {words}`\n\n{table(rows)}"
    text += "".join(f"\n- failed: {failure}" for failure in failures)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(text, encoding="utf-8")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m lab.glass_ladder", description=__doc__)
    add = parser.add_argument
    add("--preset", default="quick")
    add("--scenes", nargs="+", default=["ball_statue", "tall_bottle"])
    every = [*GROUPS, *RUNGS]
    add("--rungs", nargs="+", default=["ladder"], choices=every, metavar="NAME", help=", ".join(every))
    add("--size", default="small", choices=("small", "preset"), help="small: 128 pixels, 1,000 steps; preset: as it is")
    add("--seeds", nargs="+", type=int, default=[0])
    add("--threads", type=int, default=1)
    add("--root", type=Path, default=Path("lab/results/glass"), help="folder of store and runs")
    add("--out", type=Path, help="Markdown file (default: ROOT/ladder-PRESET.md)")
    add("--set", nargs="*", default=[], metavar="key=value", help="more words for `rtgs run`")
    arguments = parser.parse_args()
    arguments.out = arguments.out or arguments.root / f"ladder-{arguments.preset}.md"
    return arguments


def main() -> None:
    print(json.dumps(measure(parse())))


if __name__ == "__main__":
    main()
