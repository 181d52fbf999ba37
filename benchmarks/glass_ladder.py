"""What each piece of knowledge about a transparent object is worth: from its true surface down to the paper's own way.

``python -m benchmarks.glass_ladder [--scenes ball_statue tall_bottle] [--rungs NAME ...] [--preset quick]``

Every rung is a run of the pipeline (`rtgs run`) on a path-traced scene; what rungs share is trained once, and what the
store holds is not run again: stopped at any time, the same command goes on. Every eighth training view is held out and
judged beside the test views: choose by those, the test views are only reported. *Bright* pixels are masked pixels of
the test views whose true reflected layer (sRGB encoded, mean of the channels) is above the view's 90th percentile
within its mask. A Markdown table is written as it grows; last line: a JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.machine import machine
from benchmarks.specular_choices import HELD_OUT

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.config.schema import RunConfig
    from rtgs.scenes.scene import View

BRIGHT = 0.9  # quantile of the true reflected layer in the mask
_T = "method.transmittance"
_I = f"{_T}.interface"


@dataclass(frozen=True)
class Setting:
    """One scene's files: who is trained on what, and the true surface."""

    scene: str
    split: Path  # for scene.split_file
    truth: Path  # PLY of the true container
    held_out: tuple[str, ...]


@dataclass(frozen=True)
class Rung:
    """One run: what it knows, and the words that `rtgs run` is given for it."""

    what: str
    words: Callable[[Setting, RunConfig], list[str]]


def _given(setting: Setting) -> list[str]:
    return ["mesh.source=given", f"mesh.object.given={setting.truth}"]


RUNGS: dict[str, Rung] = {
    "truth": Rung("true mesh, true normals held fixed", lambda s, _: [*_given(s), f"{_T}.normal=mesh"]),
    "truth_mesh": Rung("true mesh, normals learned", lambda s, _: _given(s)),
    "hull": Rung("hull of the masks (default)", lambda *_: ["ablation=mesh_hull"]),
    "tsdf": Rung("TSDF of the base set", lambda *_: ["ablation=mesh_tsdf"]),
    "two_stages": Rung("no third stage", lambda *_: ["ablation=two_stages"]),
    "paper": Rung("the paper's way", lambda *_: ["ablation=paper_glass", "mesh.source=tsdf"]),
    "paper_early_specular": Rung(
        "the paper's way, L_spec from the second stage on",
        lambda _, c: [
            "ablation=paper_glass",
            "mesh.source=tsdf",
            f"method.loss.specular_start={c.method.reflection.start}",
        ],
    ),
    "paper_mono_in_mask": Rung(
        "the paper's way, L_mono of weight 0.2 in the mask",
        lambda _, c: ["ablation=paper_glass", "mesh.source=tsdf", f"method.loss.mono_normal_masked={_masked_gain(c)}"],
    ),
    "early_third_stage": Rung(
        "hull, third stage right after the second begins",
        lambda _, c: ["ablation=mesh_hull", f"{_T}.start={c.method.reflection.start + 0.05:g}"],
    ),
    "early_specular": Rung(
        "hull, L_spec from the second stage on",
        lambda _, c: ["ablation=mesh_hull", f"method.loss.specular_start={c.method.reflection.start}"],
    ),
    "faint_start": Rung("hull, w_r from 0.25", lambda *_: ["ablation=mesh_hull", f"{_I}.f0=0.05"]),
    "no_rim": Rung("hull, no rim", lambda *_: ["ablation=mesh_hull", f"{_T}.rim=0"]),
    "no_bound": Rung("hull, w_r not bounded", lambda *_: ["ablation=mesh_hull", f"{_T}.max_weight=0"]),
    "all_glass": Rung(
        "hull, all of it glass",
        lambda *_: ["ablation=mesh_hull", f"{_I}.masked_share=0", f"{_T}.keep_seen=0"],
    ),
    "growing_base": Rung("hull, density control goes on", lambda *_: ["ablation=mesh_hull", f"{_T}.freeze_base=false"]),
}
LADDER = tuple(RUNGS)[:10]
"""What is run when no rung is named; the others are choices of the default rung, one by one."""


def _masked_gain(config: RunConfig) -> float:
    """What brings the weight of L_mono to 0.2 (glass.md: 0.05 does little, 0.2 forms the glass)."""
    return 0.2 / (config.method.loss.mono_normal * config.method.loss.mono_normal_gain)


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
    depth_after: float | None
    normal_before: float | None
    normal_after: float | None
    silhouette_iou: float | None
    seconds: float | None  # CPU, of the third stage


COLUMNS = (
    *("scene", "rung", "held out", "in the mask", "PSNR", "SSIM", "in the mask", "SSIM", "bright"),
    *("depth before", "after", "normal before", "after", "IoU", "CPU s"),
)


def prepare(scene: str, arguments: argparse.Namespace) -> Setting:
    """Write the split and the true container of an embedded scene, world frame."""
    from rtgs.mesh.score import container_mesh
    from rtgs.mesh.triangles import write_mesh_ply
    from rtgs.scenes.importers import read_capture
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

    return compose([f"scene={scene}", "method=rtgs", f"preset={arguments.preset}", *arguments.set])[0]


def run(name: str, setting: Setting, arguments: argparse.Namespace) -> Measured | str:
    """Run the rung, or find it done; a string is why it failed."""
    words = [f"scene={setting.scene}", "method=rtgs", f"preset={arguments.preset}", f"seed={arguments.seed}"]
    words += [f"scene.split_file={setting.split}", "evaluation.lpips=false", *arguments.set]
    words += RUNGS[name].words(setting, base_config(setting.scene, arguments))
    words += [f"name={setting.scene}-{name}", f"threads={arguments.threads}", "tracking=off"]
    done = subprocess.run(
        [sys.executable, "-m", "pipelines.run", *words, f"paths.root={arguments.root}"],
        env=os.environ | {"OMP_NUM_THREADS": str(arguments.threads)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["no message"])[-1]
    return read(arguments.root, f"{setting.scene}-{name}", setting.held_out)


def read(root: Path, name: str, held_out: Sequence[str]) -> Measured:
    """The figures of a finished run."""
    folder = root / "runs" / name
    steps = json.loads((folder / "run.json").read_text(encoding="utf-8"))["steps"]
    places = {step: root / "store" / step / key[:2] / key for step, key in steps.items()}
    rows = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["views"]

    def mean(metric: str, *, judged: bool) -> float:
        return statistics.fmean(row["values"][metric] for row in rows if (row["view"] in held_out) == judged)

    boundary: dict[str, dict[str, float | None]] = {"before": {}, "after": {}}
    seconds = None
    if third := places.get("train_transmittance"):
        boundary = json.loads((third / "boundary.json").read_text(encoding="utf-8"))
        spent = [_summary(place)["cpu_seconds"] for place in (third, places["train_reflection"])]
        seconds = spent[0] - spent[1]
    before, after = boundary["before"], boundary["after"]
    figures: list[Any] = [
        mean("psnr", judged=True),
        mean("psnr_masked", judged=True),
        *(mean(metric, judged=False) for metric in ("psnr", "ssim", "psnr_masked", "ssim_masked")),
        bright_psnr(places),
        before.get("depth_share"),
        after.get("depth_share"),
        before.get("normal_share"),
        after.get("normal_share"),
        before.get("silhouette_iou"),
        seconds,
    ]
    return Measured(*figures)


def _summary(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


def bright_psnr(places: dict[str, Path]) -> float:
    """Mean PSNR over the bright pixels of the views with truth."""
    from pipelines.views import read_render
    from rtgs.evaluate.metrics import psnr
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


def row(scene: str, name: str, found: Measured) -> list[str]:
    """One line of the table."""

    def cell(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    digits = (2, 2, 2, 3, 2, 3, 2, 2, 2, 2, 2, 3, 0)
    return [scene, RUNGS[name].what, *(cell(v, d) for v, d in zip(asdict(found).values(), digits, strict=True))]


def table(rows: Sequence[Sequence[str]]) -> str:
    """The rows as Markdown."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (COLUMNS, ["---"] * len(COLUMNS), *rows)) + "\n"


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """All rungs, the table printed and written as it grows; the figures."""
    rows, figures, failures = [], [], []
    for scene in arguments.scenes:
        setting = prepare(scene, arguments)
        for name in arguments.rungs:
            found = run(name, setting, arguments)
            if isinstance(found, str):
                failures.append(f"{scene}, {name}: {found}")
                print(failures[-1], flush=True)
            else:
                rows.append(row(scene, name, found))
                figures.append({"scene": scene, "rung": name, **asdict(found)})
                print("  ".join(rows[-1]), flush=True)
            write(arguments, rows, failures)
    print(f"\n{table(rows)}", flush=True)
    return {"machine": machine(), "preset": arguments.preset, "figures": figures, "failures": failures}


def write(arguments: argparse.Namespace, rows: Sequence[Sequence[str]], failures: Sequence[str]) -> None:
    """The table so far, with the command that makes it."""
    words = f"--preset {arguments.preset} --scenes {' '.join(arguments.scenes)} --rungs {' '.join(arguments.rungs)}"
    words += f" --set {' '.join(arguments.set)}" if arguments.set else ""
    text = f"`python -m benchmarks.glass_ladder {words}`\n\n{table(rows)}"
    text += "".join(f"\n- failed: {failure}" for failure in failures)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(text, encoding="utf-8")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.glass_ladder", description=__doc__)
    add = parser.add_argument
    add("--preset", default="quick")
    add("--scenes", nargs="+", default=["ball_statue", "tall_bottle"])
    add("--rungs", nargs="+", default=list(LADDER), choices=list(RUNGS), metavar="NAME", help=", ".join(RUNGS))
    add("--seed", type=int, default=0)
    add("--threads", type=int, default=1)
    add("--root", type=Path, default=Path("benchmarks/results/glass"), help="folder of store and runs")
    add("--out", type=Path, help="Markdown file (default: ROOT/ladder-PRESET.md)")
    add("--set", nargs="*", default=[], metavar="key=value", help="more words for `rtgs run`")
    arguments = parser.parse_args()
    arguments.out = arguments.out or arguments.root / f"ladder-{arguments.preset}.md"
    return arguments


def main() -> None:
    print(json.dumps(measure(parse())))


if __name__ == "__main__":
    main()
