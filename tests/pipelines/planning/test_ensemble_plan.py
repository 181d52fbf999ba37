"""What further models add to the graph of a run, and what they leave alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from pipelines.cli.plan import plan_of_words
from pipelines.planning.graph import build_graph, shown_values
from rtgs.config import compose
from rtgs.config.opened import with_configs
from rtgs.core.errors import RtgsError
from rtgs.workflow import Step, Store
from rtgs.workflow.expectation import Expectation
from rtgs.workflow.step import StepContext
from tests.pipelines.graph_cases import GLASS, PLAIN, graph, keys


def known(step: Step) -> dict[str, str]:
    return {other.known_as: other.name for other in step.upstream}


def test_each_further_model_has_a_seed_of_its_own():
    found = graph(*PLAIN, "ensemble.members=3", "seed=2")
    (own,) = found.training
    assert [step.name for step in found.members] == ["member_1", "member_2"]
    assert [step.params.seed for step in found.members] == [1002, 2002]
    for step in found.members:
        assert replace(step.params, seed=2) == own.params
        assert step.upstream == own.upstream == (found.scene,)
        assert step.version == own.version
    for reader in (found.render, found.evaluate, found.report):
        assert [step.name for step in reader.upstream if step.name.startswith("member")] == ["member_1", "member_2"]


def test_the_run_and_its_model_are_those_of_a_run_without():
    one, three = keys(graph(*GLASS)), keys(graph(*GLASS, "ensemble.members=3"))
    same = {name for name in one if one[name] == three[name]}
    assert same == one.keys() - {"render", "evaluate"}
    assert keys(graph(*PLAIN)) == keys(graph(*PLAIN, "ensemble.preset=standard"))
    assert graph(*PLAIN).members == ()


def test_more_members_keep_those_there_are():
    two, four = keys(graph(*GLASS, "ensemble.members=2")), keys(graph(*GLASS, "ensemble.members=4"))
    members = {name: key for name, key in two.items() if name.startswith("member")}
    assert len(members) == 4
    assert members.items() <= four.items()


def test_all_stages_of_a_further_model_are_its_own():
    found = graph(*GLASS, "ensemble.members=2")
    diffuse, reflection, mesh, last = found.members
    names = ["member_1_train_diffuse", "member_1_train_reflection", "member_1_extract_mesh", "member_1"]
    assert [step.name for step in found.members] == names
    scene = {"import_scene": "import_scene"}
    assert known(diffuse) == scene
    assert known(reflection) == scene | {"train_diffuse": names[0]}
    assert known(mesh) == scene | {"train_diffuse": names[0], "train_reflection": names[1]}
    final = next(step for step in found.render.upstream if step.name == "member_1")
    assert known(final) == known(mesh) | {"extract_mesh": names[2]}
    assert final.fingerprint == last.fingerprint
    trained = [step for step in found.members if step is not mesh]
    assert {step.params.seed for step in trained} == {1000}
    assert not {step.fingerprint for step in found.members} & {step.fingerprint for step in found.training}


def test_pictures_are_of_the_ends_alone_and_times_of_all():
    found = graph(*GLASS, "ensemble.members=2")
    own = ["import_scene", *(step.name for step in found.training)]
    assert [step.known_as for step in found.render.upstream] == [*own, "member_1"]
    names = [step.known_as for step in found.evaluate.upstream]
    assert set(names) >= {"extract_mesh", "member_1_extract_mesh", "member_1"}
    assert {step.name for step in found.members} <= {step.known_as for step in found.report.upstream}


def test_a_step_sees_its_inputs_under_their_roles(tmp_path: Path):
    """The fingerprint has what a step knows its inputs as: a role alone is another recipe."""

    def nothing(params: object, context: StepContext) -> None: ...

    first = Step("first", 1, graph(*PLAIN).training[0].params, nothing)
    as_first, as_other = (Step("second", 1, first.params, nothing, (replace(first, role=role),)) for role in ("", "x"))
    assert first.fingerprint == replace(first, role="x").fingerprint
    assert as_first.fingerprint != as_other.fingerprint
    assert as_other.upstream_keys == {"x": first.fingerprint}
    with pytest.raises(ValueError, match="share a name"):
        Step("third", 1, first.params, nothing, (first, replace(first, role="first")))


def test_further_models_have_the_recipe_of_their_preset_with_the_words_of_the_run():
    words = ("scene=toycar", "method=2dgs", "preset=standard", "ensemble.members=2", "ensemble.preset=quick")
    more = ("method.loss.normal=0.01", "steps_scaler=0.5", "watch.steps=[100]")
    found = graph(*words, *more)
    alone = graph("scene=toycar", "method=2dgs", "preset=quick", "scene.long_side=800", "seed=1000", *more[:2])
    assert alone.scene.fingerprint == found.scene.fingerprint
    assert found.members[0].params == alone.training[0].params
    assert (found.members[0].params.schedule.total, found.training[0].params.schedule.total) == (1000, 2000)
    assert found.members[0].params.watch != found.training[0].params.watch


def test_tables_and_pages_say_it():
    config, choices = compose([*PLAIN, "ensemble.members=3"])
    found = build_graph(config, choices)
    assert found.evaluate.params.method == "3dgs"  # by which the paper's rows are found
    assert found.report.params.title == "toycar: 3dgs, smoke, mean of 3"
    assert ("3 models", "ensemble.members=3") in [(what, why[:18]) for what, why in found.report.params.decisions]
    assert shown_values(config)["ensemble.members"] == 3
    alone = build_graph(*compose(PLAIN))
    assert alone.report.params.title == "toycar: 3dgs, smoke"
    assert not any("models" in what for what, _ in alone.report.params.decisions)
    assert not any(key.startswith("ensemble.") for key in shown_values(compose(PLAIN)[0]))


def test_pictures_of_another_program_are_those_of_one(tmp_path: Path):
    Image.new("RGB", (4, 4)).save(tmp_path / "view.png")
    words = ["scene=toycar", "method=external", f"external.renders={tmp_path}"]
    with pytest.raises(RtgsError, match=r"ensemble\.members=2 with method=external"):
        graph(*words, "ensemble.members=2")
    found = graph(*words, "preset=standard")  # whose ensemble means nothing here
    assert (found.members, found.moved) == ((), ())
    assert not any(key.startswith("ensemble.") for key in shown_values(compose([*words, "preset=standard"])[0]))


def test_a_plan_lists_them(capsys):
    assert plan_of_words([*GLASS, "ensemble.members=2"]) == 0
    assert "member_1_extract_mesh" in capsys.readouterr().out


def test_each_is_expected_to_take_as_long_as_the_runs_own(tmp_path: Path):
    found = graph(*GLASS, "ensemble.members=2")
    store = Store(tmp_path)
    assert found.mesh is not None
    own = [*found.training[:-1], found.mesh, found.training[-1]]
    for number, step in enumerate(own, 1):
        attempt = store.new_attempt(step.name, step.fingerprint)
        store.publish(step, attempt, 100.0 * number, 100.0)
    expected = Expectation(store)
    assert [expected.seconds(step) for step in found.members] == pytest.approx([100.0, 200.0, 300.0, 400.0])


@pytest.mark.parametrize(("method", "models"), [("2dgs", 3), ("envgs", 3), ("rtgs", 2)])
def test_what_standard_is(method: str, models: int):
    """The run's own training is the longer one, the others are of ``quick``."""
    words = ("scene=ball_statue", f"method={method}")
    found, quick = graph(*words, "preset=standard"), graph(*words, "preset=quick", "scene.long_side=800", "seed=1000")
    assert len([step for step in found.members if step.name in ("member_1", "member_2", "member_3")]) == models - 1
    assert [step.params for step in found.members if step.name == "member_1"] == [quick.training[-1].params]
    assert found.training[-1].params.schedule.total > quick.training[-1].params.schedule.total
    alone = graph(*words, "preset=standard", "judge=photos")
    assert alone.members == ()
    assert graph(*words, "preset=quick").members == ()


@pytest.mark.parametrize("members", [-1, 0, 11])
def test_a_number_that_is_no_ensemble_is_refused(members: int):
    with pytest.raises(RtgsError, match=r"ensemble\.members"):
        compose([*PLAIN, f"ensemble.members={members}"])


OTHERS = {"judge=photos": "judge.plain=3dgs", "distill.teachers=2": "distill.teachers=2"}


@pytest.mark.parametrize("word", OTHERS)
def test_other_ways_to_have_several_models_are_refused(word: str):
    words = [*PLAIN[:1], "method=2dgs", "preset=smoke", word]
    for asked in ("ensemble.members=2", "ensemble={members:2}"):
        with pytest.raises(RtgsError, match=rf"ensemble\.members=2 with {OTHERS[word]}: give one"):
            compose([*words, asked])
    assert not any("model" in each.what for each in graph(*words).moved)


@pytest.mark.parametrize("word", OTHERS)
def test_they_go_before_what_a_preset_says(tmp_path: Path, word: str):
    (tmp_path / "preset").mkdir()
    more = "ensemble:\n  members: 3\n"
    (tmp_path / "preset" / "mine.yaml").write_text(f"# @package _global_\ndefaults:\n  - smoke\n  - _self_\n{more}")
    with with_configs(tmp_path):
        words = ["scene=toycar", "method=2dgs", "preset=mine"]
        assert len(graph(*words).members) == 2
        alone = graph(*words, word)
    assert alone.members == ()
    assert "mean" not in alone.evaluate.params.method
    (noted,) = [each for each in alone.moved if each.what == "one model"]
    assert noted.why == f"{OTHERS[word]}, which goes before ensemble.members=3"
    assert (noted.what, noted.why) in alone.report.params.decisions


def test_a_preset_that_has_nothing_of_the_method_is_refused():
    with pytest.raises(RtgsError, match=r"ensemble\.preset=paper_synthetic has nothing of method 3dgs"):
        compose([*PLAIN, "ensemble.members=2", "ensemble.preset=paper_synthetic"])
