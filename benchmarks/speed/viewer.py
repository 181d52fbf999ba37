"""What pictures of the viewer cost: processor seconds by size, of a new picture and of one whose layers are switched.

    python -m benchmarks.speed.viewer RUN [--root .] [--sizes 96x72,512x384] [--repeats 3]

RUN as `rtgs view` takes it; one thread, the least of the repeats, seen from the first training view. Keys of the last
line: ``picture`` and ``switched``, seconds by size.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import torch

from rtgs.core.work_time import work_time
from rtgs.runs.shown import locate_run, open_run
from rtgs.view.mixing import OWN, Choice, maps_of, pixels_of

SWITCHED = Choice(weights=((OWN, 0.0),))


def main() -> None:
    """Measure, print, JSON last."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?")
    parser.add_argument("--root", type=Path, default=Path("."))
    parser.add_argument("--sizes", default="96x72,512x384")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        found = measured(locate_run(options.root, options.run), options.sizes.split(","), options.repeats)
    finally:
        torch.set_num_threads(before)
    for what, seconds in found.items():
        print(f"{what}: {', '.join(f'{size} {each:.4f} s' for size, each in seconds.items())}")
    print(json.dumps(found))


def measured(folder: Path, sizes: list[str], repeats: int) -> dict[str, dict[str, float]]:
    """Processor seconds by kind and size."""
    run = open_run(folder)
    blend = run.method.settings.optics.blend
    picture: dict[str, float] = {}
    switched: dict[str, float] = {}
    for size in sizes:
        width, height = map(int, size.split("x"))
        camera = run.scene.train[0].camera.resized(width, height)
        maps = maps_of(run.method, camera, run.step, Choice())

        def draw(camera=camera) -> None:
            pixels_of(Choice(), maps_of(run.method, camera, run.step, Choice()), camera, blend)

        def switch(camera=camera, maps=maps) -> None:
            pixels_of(SWITCHED, maps, camera, blend)

        picture[size], switched[size] = least(draw, repeats), least(switch, repeats)
    return {"picture": picture, "switched": switched}


def least(work: Callable[[], None], repeats: int) -> float:
    """The least processor seconds of some repeats, after one that does not count."""
    work()
    taken = []
    for _ in range(repeats):
        start = work_time()
        work()
        taken.append(work_time() - start)
    return min(taken)


if __name__ == "__main__":
    main()
