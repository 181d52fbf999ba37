"""What levers on the last part of a training are worth, each alone, judged on held-out training views.

``python -m lab.late_training --scenes matte_room fox --methods 3dgs --seeds 0 1 2``

One training goes to the end of density control; every late lever goes on from there, so differences are those of the
last part alone. The vote, which changes density control, and a random background are runs of their own. Every eighth
view of the training split is held out and judged; test views are never looked at. CPU seconds are of the whole run,
without looks. A Markdown table grows on the screen, last line: a JSON object.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING

import torch

from benchmarks.common.machine import machine
from lab.late_levers import (
    Averages,
    RandomBackground,
    SeveralViewsTrainer,
    consolidate,
    let_vote,
    swapped,
)
from lab.training_choices import judged_in_training
from rtgs.core.work_time import work_time
from rtgs.train.method import Mode
from rtgs.train.schedule import densify_end

if TYPE_CHECKING:
    from rtgs.config.schema import RunConfig
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene
    from rtgs.train.method import Method
    from rtgs.train.view_order import OrderState

PRUNE_AT = 0.8  # of the run
VOTERS = 8  # views that are asked in each call of density control
HEADER = "| scene | method | seed | lever | PSNR | SSIM | Gaussians | CPU s |"
LEVERS = ("mean", "views", "steps", "prune", "vote", "background")


@dataclass(frozen=True)
class LeverScore:
    """Means over the held-out training views."""

    scene: str
    method: str
    seed: int
    lever: str
    psnr: float
    ssim: float
    gaussians: int
    cpu_seconds: float

    def row(self) -> str:
        """A line of the table."""
        cells = (self.scene, self.method, str(self.seed), self.lever, f"{self.psnr:.2f}", f"{self.ssim:.4f}")
        return f"| {' | '.join(cells)} | {self.gaussians:,} | {self.cpu_seconds:.1f} |"


@dataclass
class Looks:
    """An observer that judges along the run."""

    scene: Scene
    every: int
    seen: dict[int, tuple[float, float]] = field(default_factory=dict)  # PSNR and SSIM by step

    def look(self, method: Method, step: int) -> None:
        """Judge, every so many steps."""
        if step % self.every == 0:
            self.seen[step] = judge(method, self.scene, step)


@dataclass(frozen=True)
class Both:
    """Two observers."""

    first: Looks
    second: Averages

    def look(self, method: Method, step: int) -> None:
        """Both look."""
        self.first.look(method, step)
        self.second.look(method, step)


@dataclass(frozen=True)
class Prefix:
    """A training up to the end of density control."""

    state: dict[str, torch.Tensor]
    order: OrderState
    step: int
    cpu_seconds: float


@torch.no_grad()
def judge(method: Method, scene: Scene, step: int) -> tuple[float, float]:
    """Mean PSNR and SSIM over the held-out views, which stand in the place of test views."""
    from rtgs.evaluate.metrics import psnr, ssim

    images = [method.render(view.camera, step, Mode.EVALUATE).image for view in scene.test]
    pairs = list(zip(images, (view.image for view in scene.test), strict=True))
    return sum(psnr(*pair) for pair in pairs) / len(pairs), sum(ssim(*pair) for pair in pairs) / len(pairs)


def settled(config: RunConfig) -> int:
    """The step before which density control runs for the last time."""
    schedule = config.schedule
    return (densify_end(schedule) - 1) // schedule.densify_every * schedule.densify_every


class Session:
    """One scene, method and seed: the shared first part, and every lever on what follows."""

    def __init__(self, scene: str, method: str, seed: int, words: Sequence[str]) -> None:
        from rtgs.config.compose import compose
        from rtgs.scenes.scene import load_scene

        words = ["preset=quick", *words, f"scene={scene}", f"method={method}", f"seed={seed}"]
        self.names = (scene, method, seed)
        self.config = compose(words)[0]
        self.scene = judged_in_training(load_scene(self.config.scene))
        self.unseen = replace(self.scene, test=())  # what a trainer is given
        self.total = self.config.schedule.total
        self.looks = Looks(self.scene, max(self.total // 40, 1))

    def create(self) -> Model:
        """A model that nothing has trained."""
        from rtgs.methods import create_method
        from rtgs.methods.model import Model
        from rtgs.train.seeds import generator_for

        config = self.config
        generator = generator_for(config.seed, "initialise")
        method = create_method(config.method, self.unseen, config.schedule, generator)
        assert isinstance(method, Model)
        if len(method.stages) > 1:
            raise SystemExit(f"method {method.name} has {len(method.stages)} stages; choose one of one stage, 2dgs")
        return method

    def trainer(
        self,
        model: Model,
        from_step: int,
        until: int,
        observer: Looks | Averages | Both | RandomBackground | None = None,
    ) -> SeveralViewsTrainer:
        """Of these steps."""
        stage = replace(model.stages[0], from_step=from_step, until=until)
        return SeveralViewsTrainer(model, self.unseen, seed=self.config.seed, stage=stage, observer=observer)

    def prefix(self) -> Prefix:
        """Train to the end of density control, looking on the way."""
        model, step = self.create(), settled(self.config)
        trainer = self.trainer(model, 0, step, self.looks)
        seconds = trainer.run().cpu_seconds
        state = {name: tensor.detach().clone() for name, tensor in model.state().items()}
        return Prefix(state, trainer._order.state(), step, seconds)

    def tail(
        self,
        prefix: Prefix,
        *,
        views: int = 1,
        advance: int = 1,
        prune: float = 0.0,
        observer: Both | None = None,
    ) -> tuple[Model, float]:
        """Go on from the prefix to the end; CPU seconds of the whole run."""
        model = self.create()
        model.load(prefix.state)
        order, step, seconds = prefix.order, prefix.step, prefix.cpu_seconds
        stops = (max(round(PRUNE_AT * self.total), step), self.total) if prune else (self.total,)
        for stop in stops:
            trainer = self.trainer(model, step, stop, observer)
            trainer.views, trainer.advance = views, advance
            trainer._order.load(order)
            seconds += trainer.run().cpu_seconds
            order, step = trainer._order.state(), stop
            if stop < self.total:
                began = work_time()
                consolidate(model, self.unseen.train, step, prune)
                seconds += work_time() - began
        return model, seconds

    def score(self, model: Model, lever: str, seconds: float) -> LeverScore:
        """Judge the model as it is."""
        scene, method, seed = self.names
        count = sum(len(part) for part in model.sets)
        return LeverScore(scene, method, seed, lever, *judge(model, self.scene, self.total), count, seconds)

    def plain(self, prefix: Prefix, *, means: bool) -> list[LeverScore]:
        """The run as it is, the means of its parameters, and the best state that was seen."""
        total = self.total
        starts = {f"mean of the last {share:.0%}": round((1 - share) * total) for share in (0.05, 0.1, 0.2)}
        decays = {"exponential mean, decay .97": (total - round(0.25 * total), 0.97)}
        averages = Averages(starts if means else {}, decays if means else {})
        model, seconds = self.tail(prefix, observer=Both(self.looks, averages))
        scores = [self.score(model, "as it is", seconds)]
        for name, values in averages.means.items():
            with swapped(model, values):
                scores.append(self.score(model, name, seconds))
        best = max(self.looks.seen, key=lambda step: self.looks.seen[step][0])
        return [*scores, replace(scores[0], lever=f"best of {len(self.looks.seen)} looks, step {best}",
                                 psnr=self.looks.seen[best][0], ssim=self.looks.seen[best][1])]  # fmt: skip

    def vote(self, least: int) -> LeverScore:
        """A run whose density control asks views."""
        model = self.create()
        let_vote(model, self.unseen.train, count=VOTERS, least=least, seed=self.config.seed)
        seconds = self.trainer(model, 0, self.total).run().cpu_seconds
        return self.score(model, f"{least} of {VOTERS} views agree", seconds)

    def background(self) -> LeverScore:
        """A run with another background in every step."""
        model = self.create()
        own, random = model.base._background, RandomBackground(self.config.seed)
        random.look(model, 0)
        seconds = self.trainer(model, 0, self.total, random).run().cpu_seconds
        model.base._background = own
        return self.score(model, "random background", seconds)

    def run(self, levers: Sequence[str], agree: Sequence[int], tell: Callable[[LeverScore], None]) -> None:
        """Every lever asked for, told as it comes; ``agree``: how many views must, of the vote."""
        prefix = self.prefix()
        for score in self.plain(prefix, means="mean" in levers):
            tell(score)
        several = [("views", f"{k} views a step, as many views", k, k) for k in (2, 4)]
        for lever, name, views, advance in (*several, ("steps", "2 views a step, as many steps", 2, 1)):
            if lever in levers:
                tell(self.score(*_named(self.tail(prefix, views=views, advance=advance), name)))
        for share in (0.1, 0.3) if "prune" in levers else ():
            tell(self.score(*_named(self.tail(prefix, prune=share), f"{share:.0%} pruned at {PRUNE_AT:.0%}")))
        for least in agree if "vote" in levers else ():
            tell(self.vote(least))
        if "background" in levers:
            tell(self.background())


def _named(run: tuple[Model, float], name: str) -> tuple[Model, str, float]:
    return run[0], name, run[1]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m lab.late_training", description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=["matte_room"])
    parser.add_argument("--methods", nargs="+", default=["3dgs"], help="of one stage")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--levers", nargs="*", default=LEVERS, choices=LEVERS)
    parser.add_argument("--agree", nargs="+", type=int, default=[2, 4], help=f"of {VOTERS} views, in the vote")
    parser.add_argument("--set", default="", metavar="WORDS", help="config words of every run, in one string")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{HEADER}\n{'|---' * (HEADER.count('|') - 1)}|", flush=True)
    scores: list[LeverScore] = []

    def tell(score: LeverScore) -> None:
        scores.append(score)
        print(score.row(), flush=True)

    for scene, method, seed in itertools.product(options.scenes, options.methods, options.seeds):
        Session(scene, method, seed, options.set.split()).run(options.levers, options.agree, tell)
    print(json.dumps({"machine": machine(), "scores": [asdict(score) for score in scores]}))


if __name__ == "__main__":
    main()
