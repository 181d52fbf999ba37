"""Levers on the last part of a training: each does what its rule says, on a tiny run."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from lab import late_training
from lab.late_levers import (
    Averages,
    RandomBackground,
    SeveralViewsTrainer,
    VotedDensity,
    bad_pixels,
    consolidate,
    keep_heaviest,
    let_vote,
    parameters,
    swapped,
    votes,
    weights_on,
)
from lab.late_training import Session
from rtgs.methods.model import Model
from rtgs.train.method import Mode

WORDS = (
    "preset=smoke scene.long_side=48 schedule.total=40 schedule.densify_from=4 schedule.densify_until=30 "
    "schedule.densify_every=5 method.density.max_surfels=3000"
)


@pytest.fixture(scope="module")
def session() -> Session:
    return Session("ball_statue", "3dgs", 0, WORDS.split())


def gradients(session: Session, model: Model, trainer: SeveralViewsTrainer, monkeypatch) -> list[torch.Tensor]:
    """What Adam is handed in one step of the trainer."""
    found: list[torch.Tensor] = []

    def keep(step: int, observations: tuple) -> tuple:
        for tensor in parameters(model):
            found.append(torch.zeros_like(tensor) if tensor.grad is None else tensor.grad.clone())
            tensor.grad = None
        return ()

    monkeypatch.setattr(model, "after_step", keep)
    trainer._train_step()
    return found


def test_a_run_in_two_parts_is_the_run(session) -> None:
    whole = session.create()
    session.trainer(whole, 0, session.total).run()
    model, seconds = session.tail(session.prefix())
    assert seconds > 0
    for ours, theirs in zip(parameters(model), parameters(whole), strict=True):
        assert torch.equal(ours, theirs)


def test_the_gradient_of_two_views_is_the_mean_of_single_ones(session, monkeypatch) -> None:
    model, start = session.create(), session.total - 2
    single = session.trainer(model, start, session.total)
    alone = [gradients(session, model, single, monkeypatch) for _ in range(2)]
    together = session.trainer(model, start, session.total)
    together.views = together.advance = 2
    found = gradients(session, model, together, monkeypatch)
    assert together._step == start + 2
    for one, two, both in zip(*alone, found, strict=True):
        torch.testing.assert_close(both, (one + two) / 2, rtol=1e-4, atol=1e-8)
    assert not torch.equal(alone[0][0], alone[1][0]), "the views differ"


def test_several_views_wait_for_the_end_of_density_control(session) -> None:
    trainer = session.trainer(session.create(), 0, 2)
    trainer.views = 2
    with pytest.raises(ValueError, match="density control still runs"):
        trainer.run()


def test_means_of_constant_parameters_change_nothing(session) -> None:
    model = session.create()
    before = [tensor.detach().clone() for tensor in parameters(model)]
    averages = Averages({"all": 0, "late": 20}, {"exponential": (0, 0.9)}, every=5)
    for step in range(1, 41):
        averages.look(model, step)
    assert averages.means.keys() == {"all", "late", "exponential"}
    for means in averages.means.values():
        for mean, value in zip(means, before, strict=True):
            assert torch.equal(mean, value)


def test_means_are_means_of_the_looks_and_are_taken_back(session) -> None:
    model = session.create()
    tensor = model.base.set.gaussians.means
    first = tensor.detach().clone()
    averages = Averages({"all": 0, "late": 2}, {"exponential": (0, 0.75)}, every=1)
    for step in range(1, 5):  # the means move by 1 a step
        with torch.no_grad():
            tensor.copy_(first + step)
        averages.look(model, step)
    offsets = {name: float((means[0] - first).mean()) for name, means in averages.means.items()}
    assert offsets["all"] == pytest.approx(2.5, abs=1e-4)
    assert offsets["late"] == pytest.approx(3.5, abs=1e-4), "the looks after step 2"
    assert offsets["exponential"] == pytest.approx(2.5, abs=1e-4), "not yet longer than its memory"
    with swapped(model, averages.means["late"]):
        assert float((tensor.detach() - first).mean()) == pytest.approx(3.5, abs=1e-4)
    assert torch.equal(tensor, first + 4)


def test_weights_are_those_of_the_rasteriser_and_leave_no_gradient(session) -> None:
    model, view = session.create(), session.scene.train[0]
    seen = model.render(view.camera, 0, Mode.TRAIN).observations[0]
    every = weights_on(model, view, 0, lambda image: torch.ones_like(image[0], dtype=torch.bool))
    torch.testing.assert_close(every, seen.weight_sum, rtol=1e-3, atol=1e-4)
    left = torch.zeros(view.image.shape[1:], dtype=torch.bool)
    left[:, :20] = True
    parts = weights_on(model, view, 0, lambda _: left) + weights_on(model, view, 0, lambda _: ~left)
    torch.testing.assert_close(parts, every, rtol=1e-3, atol=1e-4)
    assert all(tensor.grad is None for tensor in parameters(model))


def test_bad_pixels_are_those_of_the_largest_error() -> None:
    photo = torch.zeros(3, 4, 5)
    image = torch.arange(20.0).reshape(4, 5).expand(3, 4, 5)
    assert bad_pixels(image, photo).flatten().nonzero().flatten().tolist() == [16, 17, 18, 19]


def test_only_what_the_views_voted_for_grows(session) -> None:
    model = session.create()
    part = model.base.set
    count = len(part)
    elected = torch.zeros(count, dtype=torch.int64)
    elected[:7], elected[7:20] = 2, 1
    settings = replace(model.settings.density, size_border=1e9, too_large=0.0, max_surfels=100_000)
    control = VotedDensity(settings, model.extent, lambda: elected, 2)
    control.observe(torch.ones(count, 2), torch.ones(count))  # all have a high signal
    report = control.densify(part.gaussians, part.optimizer, model.generator)
    assert (report.cloned, report.split, report.pruned, report.total) == (7, 0, 0, count + 7)
    assert torch.equal(part.gaussians.means[count:], part.gaussians.means[:7])


def test_density_control_asks_the_views(session) -> None:
    model = session.create()
    few = session.scene.train[:3]
    found = votes(model, few, 0)
    assert 0 <= int(found.min()) < int(found.max()) <= 3
    let_vote(model, few, count=2, least=3, seed=0)  # two views never give three votes
    before = len(model.base.set)
    session.trainer(model, 0, 12).run()
    assert len(model.base.set) <= before, "nothing grew"


def test_the_lightest_go(session) -> None:
    model = session.create()
    part = model.base.set
    count, means = len(part), part.gaussians.means.detach().clone()
    weight = torch.arange(float(count)).flip(0)  # the last rows weigh least
    gone = keep_heaviest(model, weight, 0.25)
    assert gone == round(0.25 * count)
    assert torch.equal(part.gaussians.means, means[: count - gone])
    assert part.optimizer.first["means"].shape == part.gaussians.means.shape
    consolidate(model, session.scene.train[:2], 0, 0.5)
    session.trainer(model, session.total - 2, session.total).run()


def test_every_lever_is_measured(run) -> None:
    words = ("--scenes", "ball_statue", "--levers", "mean", "views", "prune", "--set", WORDS)
    scores = {score["lever"]: score for score in run(late_training, *words)["scores"]}
    plain = scores["as it is"]
    assert scores["30% pruned at 80%"]["gaussians"] == plain["gaussians"] - round(0.3 * plain["gaussians"])
    assert all(5 < score["psnr"] < 40 for score in scores.values())
    best = next(score for name, score in scores.items() if name.startswith("best of"))
    assert best["psnr"] >= plain["psnr"]
    assert scores["2 views a step, as many views"]["psnr"] != plain["psnr"]
    assert scores["mean of the last 20%"]["psnr"] != plain["psnr"]


def test_the_background_is_another_in_every_step_and_its_own_afterwards(session, monkeypatch) -> None:
    colors: list[torch.Tensor] = []
    own = RandomBackground.look

    def look(self, method: Model, step: int) -> None:
        own(self, method, step)
        colors.append(method.base._background)

    monkeypatch.setattr(RandomBackground, "look", look)
    judged: list[torch.Tensor] = []
    judge = late_training.judge
    monkeypatch.setattr(
        late_training, "judge", lambda method, *rest: (judged.append(method.base._background), judge(method, *rest))[1]
    )
    score = session.background()
    assert len({tuple(color.tolist()) for color in colors}) == session.total + 1
    assert torch.equal(judged[0], session.create().base._background)
    assert 5 < score.psnr < 40


def test_the_drawn_background_is_what_is_seen(session) -> None:
    model, view, random = session.create(), session.unseen.train[0], RandomBackground(0)
    images = []
    for step in range(2):
        random.look(model, step)
        images.append(model.render(view.camera, 1, Mode.EVALUATE).image)
    assert (images[0] - images[1]).abs().max() > 0.05
