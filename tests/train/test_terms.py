"""Loss terms: one idiom for value, weight, when, and the maps they need."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from training_cases import small_scene

from rtgs.core.decisions import Decision
from rtgs.render.buffers import RasterBuffers
from rtgs.train.method import RenderedView, RenderOptions
from rtgs.train.terms import LossTable, LossTerm, term_start


def rendered(value: float) -> tuple[RenderedView, torch.Tensor]:
    view = small_scene(3).train[0]
    image = torch.full_like(view.image, value, requires_grad=True)
    return RenderedView(view.camera, image, RasterBuffers(image, torch.ones(image.shape[1:]))), view


def term(name: str, weight: float = 1.0, **when) -> LossTerm:
    return LossTerm(name, weight, lambda rendered, view: rendered.image.mean(), **when)


def test_the_total_is_the_weighted_sum_of_what_acts():
    shown, view = rendered(0.5)
    table = LossTable(0.8, 0.2, (term("early", 2.0, until=10), term("late", 3.0, start=10)))
    before, after = (table.evaluate(shown, view, step) for step in (9, 10))
    assert [value.name for value in before.terms] == ["l1", "dssim", "early"]
    assert [value.name for value in after.terms] == ["l1", "dssim", "late"]
    for found in (before, after):
        expected = sum(value.weight * value.value for value in found.terms)
        assert float(found.total.detach()) == pytest.approx(expected, rel=1e-5)
    (gradient,) = torch.autograd.grad(after.total - before.total, shown.image)
    assert torch.allclose(gradient, torch.full_like(gradient, 1.0 / gradient.numel()))  # 3 - 2, of the mean


def test_what_a_photo_cannot_show_is_no_error_of_any_term():
    shown, view = rendered(1.7)
    view = replace(view, image=torch.ones_like(view.image))
    table = LossTable(0.8, 0.2, (term("bright"),))
    plain, clipped = (replace(table, clipped=on).evaluate(shown, view, 0) for on in (False, True))
    found = {value.name: value.value for value in clipped.terms}
    assert found["l1"] == pytest.approx(0, abs=1e-6)
    assert found["dssim"] == pytest.approx(0, abs=1e-5)
    assert found["bright"] == pytest.approx(1)
    (gradient,) = torch.autograd.grad(clipped.total, shown.image)
    assert not gradient.any()
    assert {value.name: value.value for value in plain.terms}["bright"] == pytest.approx(1.7)
    assert float(plain.total.detach()) > float(clipped.total.detach()) + 0.5
    dark = replace(view, image=torch.full_like(view.image, 0.5))
    assert torch.equal(*(replace(table, clipped=on).evaluate(shown, dark, 0).total for on in (False, True)))


def test_only_maps_of_terms_that_act_are_asked_for():
    table = LossTable(0.8, 0.2, (term("a", needs=RenderOptions(depth=True)), term("b", start=5, needs=NORMAL)))
    assert table.needs(4) == RenderOptions(depth=True)
    assert table.needs(5) == RenderOptions(depth=True, normal=True)
    assert LossTable(1.0, 0.0).needs(0) == RenderOptions()


NORMAL = RenderOptions(normal=True)


def test_a_term_may_pass_a_view_over():
    shown, view = rendered(0.5)
    table = LossTable(1.0, 0.0, (LossTerm("masked", 1.0, lambda rendered, view: None),))
    assert [value.name for value in table.evaluate(shown, view, 0).terms] == ["l1", "dssim"]


@pytest.mark.parametrize("weight", [0.0, -1.0, math.nan, math.inf])
def test_a_term_without_a_weight_is_not_made(weight: float):
    with pytest.raises(ValueError, match="loss term 'odd' has the weight"):
        term("odd", weight)


def test_a_start_is_a_step_or_the_reason_why_there_is_none():
    assert term_start("normal", 0.1, 0.25, 200, "2dgs") == 50
    off = term_start("normal", 0.0, 0.25, 200, "2dgs")
    assert off == Decision("no normal loss", "its weight is 0 in method 2dgs")
    late = term_start("normal", 0.1, 1.0, 200, "2dgs")
    assert isinstance(late, Decision)
    assert "beyond 200 steps" in late.why
