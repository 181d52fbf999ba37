"""Which choices of the second stage reach a good reflection in a short run, judged without test views.

``python -m lab.specular_choices SCENE [--choices NAME ...] [--steps N] [--long-side PIXELS] [--seeds S ...]``

Every eighth view of the training split is held out and judged on and off the specular objects (their silhouettes come
from the scene's description by ray casting; extra ``synthetic``); test views are never looked at. The first stage is
trained once a seed and every choice goes on from it, so differences are those of the second stage. Preset ``quick``.
A Markdown table is printed, last line: a JSON object.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from re import sub
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from rtgs.core.work_time import work_time

if TYPE_CHECKING:
    from rtgs.config.schema import RunConfig
    from rtgs.methods import Method
    from rtgs.scenes.scene import Scene, View

HELD_OUT = 8  # every so many training views
MIRROR_BALL = "mirror_ball"  # benchmarks/common/mirror_scene.py, instead of an embedded scene
_M, _O = "method.materials", "method.optics"
_DIELECTRIC = ("method=rtgs", f"{_M}.f0=0.04", f"{_M}.roughness=0.005", f"{_O}.max_gain=16")
_POINTS = "method.reflection.box_reach=0"
_COSINE = "method.loss.mono_normal_form=cosine"
_WEAK = "method.loss.mono_normal_gain=1"
CHOICES: dict[str, tuple[str, ...]] = {  # the methods' own configs first
    "2dgs": ("method=2dgs",),
    "envgs": ("method=envgs",),
    "rtgs": ("method=rtgs",),
    "all as before": (
        *_DIELECTRIC,
        _POINTS,
        _WEAK,
        _COSINE,
    ),  # memo's start, box of the points, published weight of L_mono
    "dielectric start": _DIELECTRIC,
    "half mirror, S_max 16": ("method=rtgs", f"{_M}.f0=0.5", f"{_M}.roughness=0.02", f"{_O}.max_gain=16"),
    "k_s from 0.3": ("method=rtgs", f"{_M}.specular=0.3"),
    "L_mono as a cosine": ("method=rtgs", _COSINE),
    "L_mono as published": ("method=rtgs", _WEAK, _COSINE),
    "L_mono x 50": ("method=rtgs", _COSINE, "method.loss.mono_normal_gain=50"),
    "box of the points": ("method=rtgs", _POINTS),
}


@dataclass(frozen=True)
class ChoiceScore:
    """Means over the held-out views; the layers' means over specular pixels of k_s, w_r and what they come from."""

    choice: str
    seed: int
    psnr: float
    psnr_specular: float
    psnr_rest: float
    normal_error: float  # median over specular pixels, degrees
    train_specular: float  # the same on the views that were trained on
    k_s: float | None
    k_s_rest: float | None  # k_s off the specular objects
    w_r: float | None  # k_s w_r C_r over k_s C_r
    roughness: float | None
    f0: float | None
    traced_color: float | None  # C_r
    seconds: float  # CPU, of the second stage


@dataclass(frozen=True)
class Setting:
    """What every choice is trained and judged on."""

    scene: str
    side: int
    train: Scene  # without views to judge
    judged: tuple[View, ...]
    known: dict[str, Tensor]  # by view name, of :func:`known_geometry`
    root: Path


def known_geometry(scene: str, views: Sequence[View]) -> dict[str, Tensor]:
    """(4, H, W) by view name: world normal, and 1 on mirror, gloss or glass; rays cast into the scene's description."""
    from rtgs.scenes.synthetic.description import SPECULAR, named_scene
    from rtgs.scenes.synthetic.render import PathTracer

    description = named_scene(scene)
    tracer = PathTracer(description)
    kinds = torch.tensor([shape.material.kind in SPECULAR for shape in description.shapes])
    known = {}
    for view in views:
        seen = tracer.geometry(view.camera)
        shape, normal = torch.from_numpy(seen.shape).long(), torch.from_numpy(seen.normal)
        inside = kinds[shape.clamp_min(0)] & (shape >= 0)
        world = torch.einsum("cw,hxc->whx", view.camera.rotation.float(), normal)
        known[view.name] = torch.cat((world, inside[None].float()))
    return known


def load_setting(options: argparse.Namespace) -> Setting:
    from rtgs.scenes.scene import load_scene

    if options.scene == MIRROR_BALL:
        return ball_setting(options)
    scene, judged = held_out(load_scene(compose_choice(options, ()).scene))
    views = (*scene.train, *judged)
    known = cached(
        options.root / f"known-{options.scene}-{options.long_side}.pt", lambda: known_geometry(options.scene, views)
    )
    return Setting(options.scene, options.long_side, scene, judged, known, options.root)


def ball_setting(options: argparse.Namespace) -> Setting:
    """The mirror ball of the tests: small, exact, and without monocular normals."""
    from benchmarks.common.mirror_scene import BALL, RADIUS, ball_hit, mirror_scene

    side = options.long_side
    scene, judged = held_out(mirror_scene(40, side, 3 * side // 4).scene)
    known = {}
    for view in (*scene.train, *judged):
        rays = view.camera.rays()
        direction = torch.nn.functional.normalize(rays.directions.reshape(-1, 3), dim=1)
        hit, t = ball_hit(rays.origin.expand_as(direction), direction)
        normal = (rays.origin + t[:, None] * direction - BALL) / RADIUS * hit[:, None]
        known[view.name] = torch.cat((normal.T, hit[None].float())).reshape(4, 3 * side // 4, side)
    return Setting(options.scene, side, scene, judged, known, options.root)


def held_out(scene: Scene, first: int = HELD_OUT // 2) -> tuple[Scene, tuple[View, ...]]:
    """The scene without its test views and without the views to judge, every eighth from ``first`` on, and these."""
    judged = scene.train[first::HELD_OUT]
    kept = tuple(view for view in scene.train if not any(view is other for other in judged))
    return replace(scene, train=kept, test=()), judged


def compose_choice(options: argparse.Namespace, choice: Sequence[str]) -> RunConfig:
    from benchmarks.common.training_runs import schedule_overrides
    from rtgs.config.compose import compose

    words = [f"preset={options.preset}"]
    if options.scene == MIRROR_BALL:  # small enough for seconds: as many surfels as its pixels can tell apart
        words += ["method.density.max_surfels=6000", "method.reflection.cells=9"]
    else:
        words += [f"scene={options.scene}", f"scene.long_side={options.long_side}"]
    if options.steps:
        words += schedule_overrides(options.steps, options.preset)
    return compose([*words, *options.set, *choice])[0]


def trained(config: RunConfig, scene: Scene, seed: int, first: dict[str, Tensor] | None) -> tuple[Method, float]:
    """A method trained to its end from the state ``first`` of its first stage; CPU seconds of what was trained."""
    from rtgs.methods import create_method
    from rtgs.train.seeds import generator_for
    from rtgs.train.trainer import Trainer

    method = create_method(config.method, scene, config.schedule, generator_for(seed, "initialise"))
    stages = method.stages
    if first is not None and len(stages) > 1:
        method.load(first)
        stages = stages[1:]
    began = work_time()
    for stage in stages:
        Trainer(method, scene, seed=seed, stage=stage).run()
    return method, work_time() - began


def first_stage(config: RunConfig, setting: Setting, seed: int) -> dict[str, Tensor] | None:
    """The state at the end of the first stage, kept for all choices that agree on it; None where there is one stage."""
    from rtgs.methods import create_method, find_method
    from rtgs.train.seeds import generator_for
    from rtgs.train.trainer import Trainer

    method = create_method(config.method, setting.train, config.schedule, generator_for(seed, "initialise"))
    if len(method.stages) == 1:
        return None

    def make() -> dict[str, Tensor]:
        Trainer(method, setting.train, seed=seed, stage=method.stages[0]).run()
        return method.state()

    reads = repr(
        (
            find_method(config.method.name).stage("diffuse").reads(config.method),
            config.schedule,
            seed,
            setting.side,
            method.stages[0].until,
        )
    )
    return cached(setting.root / f"first-{setting.scene}-{sha256(reads.encode()).hexdigest()[:12]}.pt", make)


def cached(path: Path, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
    """What ``make`` returned the first time. Delete the file after a change of the code."""
    if not path.is_file():
        made = make()
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(made, path)
    return torch.load(path, weights_only=True)


@torch.no_grad()
def score(method: Method, choice: str, seed: int, seconds: float, setting: Setting) -> ChoiceScore:
    """Render the held-out views, and some of the training views, and compare."""
    from rtgs.evaluate.metrics import psnr
    from rtgs.methods import Mode, RenderOptions

    def rendered(view: View):
        return method.render(view.camera, method.schedule.total, Mode.EVALUATE, RenderOptions(layers=True, normal=True))

    rows, layers = [], []
    for view in setting.judged:
        normal, inside = setting.known[view.name][:3], setting.known[view.name][3] > 0
        seen = rendered(view)
        assert seen.buffers.normal is not None  # asked for
        cosine = (torch.nn.functional.normalize(seen.buffers.normal, dim=0) * normal).sum(0)[inside]
        tilt = cosine.clamp(-1, 1).acos().rad2deg().median()
        parts = [psnr(seen.image, view.image, mask=mask) for mask in (inside, ~inside)]
        rows.append([psnr(seen.image, view.image), *parts, float(tilt)])
        if seen.layers is not None:
            layers.append(_layer_means(seen.layers, inside))
        if view is setting.judged[2]:
            _write_picture(setting.root / "pictures" / _file_name(setting, choice, seed), seen, view)
    some = setting.train.train[:: len(setting.train.train) // 6]
    again = [psnr(rendered(view).image, view.image, mask=setting.known[view.name][3] > 0) for view in some]
    means = torch.tensor(rows).mean(0).tolist()
    maps = torch.tensor(layers).mean(0).tolist() if layers else [None] * 6
    figures: list[Any] = [*means, sum(again) / len(again), *maps, seconds]
    return ChoiceScore(choice, seed, *figures)


def _layer_means(layers: Mapping[str, Tensor], inside: Tensor) -> list[float]:
    """k_s, k_s elsewhere, w_r, roughness, f0, C_r: means over specular pixels."""
    share, color = layers["specular"][inside], layers["reflected_color"][:, inside]
    gain = layers["reflection"][:, inside].sum() / (share * color).sum().clamp_min(1e-9)
    f0 = layers["f0"] if layers["f0"].ndim == 2 else layers["f0"].mean(0)
    means = (share, layers["specular"][~inside], gain, layers["roughness"][inside], f0[inside], color)
    return [float(values.mean()) for values in means]


def _file_name(setting: Setting, choice: str, seed: int) -> str:
    return f"{setting.scene}-{sub('[^A-Za-z0-9_.=-]+', '_', choice)[:120]}-{seed}.png"


def _write_picture(path: Path, rendered, view: View) -> None:
    """Photo, image, and the layers side by side."""
    from rtgs.evaluate.images import write_png

    parts = [view.image, rendered.image, 0.5 - 0.5 * rendered.buffers.normal]
    if rendered.layers is not None:
        maps = rendered.layers
        parts += [maps["diffuse"], maps["reflection"], maps["reflected_color"]]
        parts += [m.expand(3, *m.shape[-2:]) for m in (maps["specular"], maps["roughness"].sqrt(), maps["f0"])]
    rows = [torch.cat([p.clamp(0, 1) for p in parts[k : k + 3]], dim=2) for k in range(0, len(parts), 3)]
    pixels = (torch.cat(rows, dim=1).permute(1, 2, 0) * 255).round().to(torch.uint8)
    write_png(path, pixels.numpy())


def row(result: ChoiceScore) -> str:
    def cell(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    cells = [result.choice, str(result.seed)]
    cells += [cell(v, 2) for v in (result.psnr_specular, result.psnr_rest, result.psnr, result.train_specular)]
    cells += [cell(result.normal_error, 1)]
    cells += [cell(v, 2) for v in (result.k_s, result.k_s_rest, result.w_r)] + [cell(result.roughness, 4)]
    cells += [cell(v, 2) for v in (result.f0, result.traced_color)] + [cell(result.seconds, 0)]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m lab.specular_choices", description=__doc__)
    parser.add_argument("scene", help="an embedded path-traced scene")
    parser.add_argument("--choices", nargs="*", choices=list(CHOICES), default=[], metavar="NAME")
    parser.add_argument(
        "--also", nargs="*", default=[], metavar="WORDS", help="more choices: config words in one string"
    )
    parser.add_argument("--set", nargs="*", default=[], help="config words for every choice")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--steps", type=int, help="shorten the schedule of the preset")
    parser.add_argument("--long-side", type=int, default=256)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--root", type=Path, default=Path("outputs/specular_choices"), help="first stages, pictures")
    options = parser.parse_args()
    setting = load_setting(options)
    choices = {name: CHOICES[name] for name in options.choices} | {
        words: tuple(words.split()) for words in options.also
    }
    print("| choice | seed | on specular | elsewhere | all | trained, specular | normals off by | k_s | elsewhere "
          "| w_r | roughness | f0 | C_r | CPU s |")  # fmt: skip
    print("|" + "---|" * 14, flush=True)
    results = []
    for seed in options.seeds:
        for choice, words in choices.items():
            config = compose_choice(options, words)
            first = first_stage(config, setting, seed)
            method, seconds = trained(config, setting.train, seed, first)
            results.append(score(method, choice, seed, seconds, setting))
            print(row(results[-1]), flush=True)
    print(json.dumps({"scene": options.scene, "results": [asdict(result) for result in results]}))


if __name__ == "__main__":
    main()
