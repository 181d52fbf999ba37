"""The verdict on a scene: what counts as evidence, and that a scene with mirrors keeps its second stage."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny

from rtgs.methods import Mode, Stage
from rtgs.methods.parts.matte import MatteEvidence, gather_evidence
from rtgs.methods.parts.mirror import Mirror
from rtgs.methods.settings import MatteSettings, PropagationSettings


def test_evidence_is_the_share_of_specular_pixels_and_what_tracing_lowers_there():
    photo, specular = torch.full((3, 4, 5), 0.5), torch.zeros(4, 5)
    specular[0, :2] = 0.2
    image, diffuse = photo.clone(), photo.clone()
    image[:, 0, :2] += 0.1
    diffuse[:, 0, :2] += 0.2
    image[:, 1] = diffuse[:, 1] = 9  # not specular: does not count
    view = SimpleNamespace(image=photo)
    rendered = SimpleNamespace(image=image, layers={"specular": specular, "diffuse": diffuse})
    plain = SimpleNamespace(image=image, layers={"specular": 0 * specular, "diffuse": diffuse})
    found = gather_evidence([(rendered, view), (plain, view)], 0.15)  # type: ignore[list-item]
    assert found.share == pytest.approx(2 / 40)
    assert found.gain == pytest.approx(0.75)
    assert gather_evidence([(rendered, view)], 0.25) == MatteEvidence(0.0, 0.0)  # type: ignore[list-item]


def test_fewer_specular_pixels_than_the_share_are_a_matte_scene():
    settings = MatteSettings(share=0.05)
    assert MatteEvidence(0.049, 0.9).is_matte(settings)
    assert not MatteEvidence(0.05, -0.9).is_matte(settings)


@pytest.mark.parametrize("name", ["rtgs", "envgs"])
def test_a_scene_with_mirrors_keeps_its_second_stage(name: str):
    made = tiny()
    method = new_method(recipe(name, matte=MatteSettings(probation=0.05, views=3)), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    with torch.no_grad():
        method["base"].gaussians["specular_logits"][:100] = 1.0  # type: ignore[union-attr]
    told = []
    for step in range(15, 20):
        view = made.scene.train[step % len(made.scene.train)]
        rendered = method.render(view.camera, step, Mode.TRAIN)
        method.losses(rendered, view, step).total.backward()
        told += [
            (step + 1, event.detail)
            for event in method.after_step(step, rendered.observations)
            if event.kind == "decision"
        ]
    assert [step for step, _ in told] == [18]
    assert told[0][1].startswith("goes on: ")
    assert len(method.sets) == 2
    assert all(decision.what != "the reflection stage ended early" for decision in method.decisions)


@pytest.mark.parametrize("strength", [0.0, 0.8])
def test_the_verdict_comes_before_anything_changes(strength: float, monkeypatch: pytest.MonkeyPatch):
    """Judged at step 20, where the base set is densified too: on the set as it was trained."""
    made = tiny(strength)
    quiet = PropagationSettings(every=0)
    method = new_method(recipe(matte=MatteSettings(probation=1 / 12, views=3), propagation=quiet), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    judged: list[int] = []
    look = Mirror._look

    def counting(part: Mirror, view, step: int):
        judged.append(len(method["base"]))
        return look(part, view, step)

    monkeypatch.setattr(Mirror, "_look", counting)
    before = len(method["base"])
    rendered = method.render(made.scene.train[0].camera, 19, Mode.TRAIN)
    method.losses(rendered, made.scene.train[0], 19).total.backward()
    kinds = [(event.kind, event.set_name) for event in method.after_step(19, rendered.observations)]
    assert kinds[0] == ("decision", "reflection")
    assert ("density", "base") in kinds[1:]
    assert judged == [before] * 3
    assert len(method["base"]) != before
    assert (method.base.rules is None) == (method.find("reflection") is None), "a matte scene goes on by its schedule"
