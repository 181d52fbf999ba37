"""When test poses are fitted to their photos, and what learning from each photo changes in a run's recipes."""

from __future__ import annotations

import pytest

from pipelines.planning.graph import RunGraph, build_graph
from rtgs.config import compose
from rtgs.core.errors import RtgsError

LEARNED = "method.poses.enabled=true"


def planned(*words: str) -> RunGraph:
    return build_graph(*compose(["scene=demo", "preset=smoke", *words]))


@pytest.mark.parametrize(
    ("words", "steps"),
    [
        (("method=2dgs",), 50),  # where the scene's poses are unsure
        (("method=2dgs", "method.poses.learn_above=null"), 0),
        (("method=rtgs",), 0),
        (("method=2dgs", LEARNED), 50),
        (("method=3dgs", LEARNED, "evaluation.refine_steps=20"), 20),
        (("method=2dgs", LEARNED, "evaluation.refined_poses=never"), 0),
        (("method=3dgs", "evaluation.refined_poses=always"), 50),
        (("method=2dgs", "evaluation.refined_poses=never"), 0),
    ],
)
def test_test_poses_are_refined_where_poses_are_learned_or_it_is_asked_for(words: tuple[str, ...], steps: int):
    params = planned(*words).render.params
    assert params.refine_steps == steps
    assert params.refine_all == ("evaluation.refined_poses=always" in words)


def test_methods_that_trace_rays_cannot_have_them_refined():
    with pytest.raises(RtgsError, match=r"^evaluation.refined_poses=always, but method rtgs is not 'ras"):
        planned("method=rtgs", "evaluation.refined_poses=always")


@pytest.mark.parametrize("words", [(LEARNED,), ("method.appearance.enabled=true",)])
def test_what_is_learned_belongs_to_the_recipe_of_training(words: tuple[str, ...]):
    plain, learned = planned("method=2dgs"), planned("method=2dgs", *words)
    assert plain.scene.fingerprint == learned.scene.fingerprint
    assert plain.training[0].fingerprint != learned.training[0].fingerprint


def test_every_stage_reads_the_exposures():
    plain, learned = (planned("method=envgs", f"method.appearance.enabled={word}") for word in ("false", "true"))
    pairs = zip(plain.training, learned.training, strict=True)
    assert len(plain.training) == 2
    assert all(one.fingerprint != other.fingerprint for one, other in pairs)
