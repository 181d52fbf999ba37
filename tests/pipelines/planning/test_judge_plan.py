"""What a judge on photos adds to the graph of a run, and what it leaves alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.planning.graph import RunGraph, build_graph, shown_values
from pipelines.planning.judge import Opponent, until_judged, why_judged_late, why_photos_unseen
from rtgs.config import compose
from rtgs.config.compose import compose_plain
from rtgs.config.schema import Choices
from rtgs.core.errors import RtgsError
from rtgs.methods import Stage
from rtgs.methods.photo_settings import AppearanceSettings
from rtgs.workflow import Store, topological
from rtgs.workflow.expectation import Expectation, PlanClock
from rtgs.workflow.plan import Plan, PlannedStep

UNSEEN = ["exposures of photos not compared", "poses of photos not judged"]
GLASS = ("scene=ball_statue", "method=rtgs", "preset=smoke")


def graph(*words: str) -> RunGraph:
    return build_graph(*compose(words))


def keys(found: RunGraph) -> dict[str, str]:
    """Without the report's, which names the words of the command."""
    return {step.name: step.fingerprint for step in topological(found.targets) if step.name != "report"}


def test_the_plain_method_is_trained_on_the_same_scene_and_the_judge_sees_both():
    found = graph(*GLASS, "judge=photos")
    plain, judge, plain_rest = found.judge
    *until, rest = found.training
    assert found.scene.params.settings.hold_out == 12
    assert plain.upstream == (found.scene,)
    assert judge.upstream == (found.scene, *until, plain)
    assert [step.name for step in until] == ["train_diffuse", "train_reflection", "train_transmittance"]
    assert all(found.scene in step.upstream for step in found.training)
    assert (rest.name, plain_rest.name) == ("train_transmittance_rest", "plain_rest")
    assert rest.upstream == (*until[-1].upstream, until[-1], judge)
    assert plain_rest.upstream == (found.scene, plain, judge)
    for reader in (found.render, found.evaluate, found.report):
        assert {plain, judge, rest, plain_rest} <= set(reader.upstream)
    assert found.evaluate.params.method == "rtgs, judged"
    assert (judge.params.full, judge.params.plain) == ("rtgs", "3dgs")
    assert compose([*GLASS, "judge=photos"])[0].name == "ball_statue-rtgs-smoke-judged"


def test_both_are_judged_in_the_last_stage_at_one_share_of_the_run_and_gone_on_with_from_there(tmp_path: Path):
    found = graph(*GLASS, "judge=photos", "judge.at=0.5", "method.transmittance.start=0.6", "schedule.total=200")
    plain, judge, plain_rest = found.judge
    *_, last, rest = found.training
    assert (last.params.from_step, last.params.until, judge.params.at) == (120, 160, (160, 160))
    for first, second in ((last, rest), (plain, plain_rest)):
        total = first.params.schedule.total
        assert (first.params.until, first.params.joined) == (total * 4 // 5, 0)
        assert second.params == replace(first.params, until=total, joined=total * 4 // 5)
    expected = Expectation(Store(tmp_path))
    assert expected.seconds(plain_rest) == pytest.approx(expected.seconds(plain) / 4)


def test_judged_at_the_end_nothing_goes_on():
    found = graph(*GLASS, "judge=photos", "judge.at=1")
    assert [step.name for step in found.judge] == ["plain", "judge"]
    assert found.training[-1].name == "train_transmittance"
    assert found.training[-1].params.until == found.training[-1].params.schedule.total
    assert found.judge[1].params.at is None


@pytest.mark.parametrize("part", ["poses", "appearance"])
def test_what_is_learned_of_each_photo_needs_all_of_it(part: str):
    words = ("scene=ball_statue", "method=2dgs", "preset=smoke", f"method.{part}.enabled=true", "judge=photos")
    found = graph(*words)
    assert [step.name for step in found.judge] == ["plain", "judge"]
    told = [each.why for each in found.moved if each.what == "judged at the end of the run"]
    assert told
    assert told[0].startswith(f"method.{part}.enabled learns something of each photo")
    assert not [each for each in graph(*words, "judge.at=1").moved if each.what == "judged at the end of the run"]


def test_what_the_plain_method_learns_of_each_photo_needs_all_of_it_too():
    config, choices = compose([*GLASS, "judge=photos"])
    opponent = Opponent.of(config, choices)
    assert opponent is not None
    stages = (Stage("diffuse", 0, 100),)
    assert until_judged(config, opponent, stages) == (Stage("diffuse", 0, 70),)
    learning = replace(opponent, method=replace(opponent.method, appearance=AppearanceSettings(enabled=True)))
    assert until_judged(config, learning, stages) == stages
    (told,) = why_judged_late(config, learning)
    assert told.why.startswith("method=3dgs: method.appearance.enabled learns")


@pytest.mark.parametrize(("words", "looks"), [((), False), (("judge.at=1",), True), (("judge=none",), True)])
def test_photos_that_join_late_are_not_looked_at(words: tuple[str, ...], looks: bool):
    found = graph(*GLASS, "judge=photos", *words)
    trainings = (*found.training, *(step for step in found.judge if step.name.startswith("plain")))
    assert all((step.params.method.appearance.learn_above is not None) is looks for step in trainings)
    assert all((step.params.method.poses.learn_above is not None) is looks for step in trainings)
    told = [each.what for each in found.moved if each.what in UNSEEN]
    assert told == ([] if looks else UNSEEN[:1])  # nobody would have learned poses where rays are traced
    asked = graph(*GLASS, "judge=photos", "method.appearance.enabled=true", *words)
    assert not [each for each in asked.moved if each.what in UNSEEN]


def test_poses_of_photos_that_join_late_are_not_judged():
    """Of a method that could learn them."""
    config, _ = compose([*GLASS, "judge=photos"])
    rasterised = replace(config, method=replace(config.method, name="2dgs"))
    assert [each.what for each in why_photos_unseen(rasterised)] == UNSEEN
    silent = replace(rasterised.method, poses=replace(rasterised.method.poses, learn_above=None))
    assert [each.what for each in why_photos_unseen(replace(rasterised, method=silent))] == UNSEEN[:1]


def test_a_rest_that_a_judge_drops_says_nothing_of_the_pace(tmp_path: Path):
    *_, last, rest = graph(*GLASS, "judge=photos").training
    plan = Plan((PlannedStep(last, False, ""), PlannedStep(rest, False, "")))
    clock = PlanClock(plan, Expectation(Store(tmp_path)), now=lambda: 0.0)
    before = clock.left()
    clock.finish(rest.fingerprint, 0.0)
    assert clock.left() == pytest.approx(before - clock.weights[rest.fingerprint])


@pytest.mark.parametrize("wrong", ["0", "1.5"])
def test_a_share_that_is_none_is_refused(wrong: str):
    with pytest.raises(RtgsError, match=f"judge.at={wrong}.* must be above 0, at most 1"):
        graph(*GLASS, "judge=photos", f"judge.at={wrong}")


def test_the_plain_method_has_its_own_numbers_at_the_preset_of_the_run():
    words = ("schedule.total=200", "method.density.max_surfels=123", "judge.every=5", "seed=4")
    found = graph(*GLASS, "judge=photos", "judge.at=1", *words)
    plain, *_ = found.judge
    alone = graph("scene=ball_statue", "method=3dgs", "preset=smoke", "scene.hold_out=5", *words[:1], "seed=4")
    assert plain.recipe == alone.training[0].recipe  # also what a stage of 3dgs reads
    assert plain.params.until == 200
    assert found.scene.fingerprint == alone.scene.fingerprint
    assert plain.fingerprint != alone.training[0].fingerprint  # its name is another: no step has two of one


@pytest.mark.parametrize("preset", ["smoke", "quick", "standard", "paper"])
def test_every_preset_gives_the_plain_method_its_own_schedule(preset: str):
    own, _ = compose(["method=3dgs", f"preset={preset}"])
    assert compose_plain("3dgs", Choices(preset=preset, method="rtgs")) == (own.method, own.schedule)


def test_without_a_judge_nothing_changes():
    """Nor with one that is not for the method, nor by the number that it alone reads."""
    plain = keys(graph(*GLASS))
    assert keys(graph(*GLASS, "judge=none")) == plain
    assert keys(graph(*GLASS, "judge.every=3")) == plain
    judged = keys(graph(*GLASS, "judge=photos"))
    assert set(judged) - set(plain) == {"plain", "judge", "train_transmittance_rest", "plain_rest"}
    assert not set(judged.values()) & set(plain.values())
    words = ("scene=ball_statue", "method=3dgs", "preset=smoke")
    own = graph(*words, "judge=photos")
    assert own.judge == ()
    assert [(step.what, step.why) for step in own.skipped if step.what == "judge"] == [
        ("judge", "3dgs is the plain method itself (judge.plain)")
    ]
    assert keys(own) == keys(graph(*words))


def test_the_page_names_the_judge_only_where_there_is_one():
    judged, alone = (shown_values(compose([*GLASS, f"judge={name}"])[0]) for name in ("photos", "none"))
    assert {key: judged[key] for key in judged.keys() - alone.keys()} == {
        "judge.plain": "3dgs",
        "judge.every": 12,
        "judge.at": 0.7,
        "scene.hold_out": 0,
    }


def test_masks_and_normals_are_shared_with_runs_without_a_judge():
    """Steps that make them look at all photos in any case."""
    words = ("scene=ball_statue", "method=rtgs", "preset=smoke", "masks=given")
    made, judged = keys(graph(*words)), keys(graph(*words, "judge=photos"))
    assert made["masks"] == judged["masks"]
    assert made["import_scene"] != judged["import_scene"]


@pytest.mark.parametrize("table", ["table1", "table2", "table3", "fig_split_sum", "captures"])
def test_tables_ask_for_the_pure_methods(table: str):
    config, _ = compose([f"experiment={table}"])
    assert config.judge.plain == ""


def test_a_plain_method_of_several_stages_is_refused():
    with pytest.raises(RtgsError, match=r"judge.plain=envgs trains in several stages \(diffuse, reflection\)"):
        graph(*GLASS, "judge.plain=envgs")
    with pytest.raises(RtgsError, match=r"judge.every=0 must be at least 1"):
        graph(*GLASS, "judge.every=0")
