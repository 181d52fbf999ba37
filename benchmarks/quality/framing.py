"""How many training views show what the test pixels of the path-traced scenes show, with and without the wide lens.

``python -m benchmarks.quality.framing [SCENE ...]``

Nothing is rendered: rays are cast at the described shapes, so it takes seconds a scene, and viewpoints can be judged
before they are paid for. A pixel counts as shown by a training view that frames its true first surface with nothing
before it (``rtgs.evaluate.coverage``). Prints the share of the test pixels that fewer than three training views show,
as a Markdown table: as described, and with all views on the plain rings; last line: a JSON object.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from rtgs.evaluate.coverage import FRAMED_BY, framed_by
from rtgs.scenes.synthetic.description import SceneDescription, list_scenes, named_scene, read_description
from rtgs.scenes.synthetic.render import PathTracer
from rtgs.scenes.synthetic.settings import CaptureSettings
from rtgs.scenes.synthetic.viewpoints import cameras


@dataclass(frozen=True)
class Framing:
    """Shares of the test pixels of one scene."""

    few: float  # shown by fewer than three training views
    none: float  # by none
    worst: float  # the first, of the test view where it is largest
    few_plain: float  # the first, with all views on the plain rings
    worst_plain: float

    def row(self, scene: str) -> str:
        """One line of the table, in percent."""
        shares = (self.few_plain, self.worst_plain, self.few, self.worst, self.none)
        return f"| {scene} | {' | '.join(f'{100 * share:.1f}' for share in shares)} |"


def framing(description: SceneDescription, settings: CaptureSettings, variant: str | None = None) -> Framing:
    """Cast the rays of all views of a scene, twice those that the wide lens moves.

    Raises:
        RtgsError: Mitsuba is not there.
    """
    tracer = PathTracer(description, settings.seed, variant)
    views = description.viewpoints
    size = (settings.width, settings.height, settings.seed)
    plain = cameras(replace(views, wide_every=0), *size)
    indices = range(views.count)
    depths = [torch.from_numpy(tracer.geometry(camera).depth) for camera in plain]
    pictures = [(plain[index], depths[index]) for index in indices if settings.is_test(index)]
    training = [index for index in indices if not settings.is_test(index)]
    moved = [camera for index, camera in enumerate(cameras(views, *size)) if views.is_wide(index)]
    stay = framed_by(pictures, ((plain[i], depths[i]) for i in training if not views.is_wide(i)))
    before = framed_by(pictures, ((plain[i], depths[i]) for i in training if views.is_wide(i)))
    after = framed_by(pictures, ((camera, torch.from_numpy(tracer.geometry(camera).depth)) for camera in moved))
    now, then = ([a + b for a, b in zip(stay, more, strict=True)] for more in (after, before))
    few, few_plain = _few(now, FRAMED_BY), _few(then, FRAMED_BY)
    return Framing(_mean(few), _mean(_few(now, 1)), max(few), _mean(few_plain), max(few_plain))


def _few(counts: Sequence[Tensor], least: int) -> list[float]:
    return [float((count < least).double().mean()) for count in counts]


def _mean(shares: Sequence[float]) -> float:
    return sum(shares) / len(shares)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality.framing", description=__doc__)
    parser.add_argument("scenes", nargs="*", help=f"of {', '.join(list_scenes())}, or TOML files; none: all of them")
    parser.add_argument("--width", type=int, default=CaptureSettings.width)
    parser.add_argument("--height", type=int, default=CaptureSettings.height)
    options = parser.parse_args()
    settings = CaptureSettings(options.width, options.height)
    print("| scene | plain rings: below three, % | worst view | as described: below three, % | worst view | none, % |")
    print("|---|---|---|---|---|---|")
    found: dict[str, float] = {}
    for scene in options.scenes or list_scenes():
        description = read_description(Path(scene)) if scene.endswith(".toml") else named_scene(scene)
        shares = framing(description, settings)
        found[description.name] = round(shares.few, 4)
        print(shares.row(description.name), flush=True)
    print(json.dumps({"below_three": found}))


if __name__ == "__main__":
    main()
