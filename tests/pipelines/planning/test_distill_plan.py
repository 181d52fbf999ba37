"""What teachers add to the graph of a run, and what they leave alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from pipelines.cli.plan import plan_of_words
from pipelines.planning.graph import shown_values
from pipelines.planning.plan import steps_of_words
from pipelines.steps.pseudo_views import PseudoParams
from rtgs.config import compose
from rtgs.config.opened import with_configs
from rtgs.core.errors import RtgsError
from rtgs.workflow import Store
from rtgs.workflow.expectation import Expectation
from tests.pipelines.graph_cases import GLASS, PLAIN, graph, keys


def test_each_teacher_has_a_seed_of_its_own_and_only_the_pseudo_views_know_them():
    found = graph(*PLAIN, "distill.teachers=3", "seed=2", "distill.views=2", "distill.most=50")
    *teachers, pseudo = found.distill
    (student,) = found.training
    assert [step.name for step in teachers] == ["teacher_1", "teacher_2", "teacher_3"]
    assert [step.params.seed for step in teachers] == [1002, 2002, 3002]
    assert all(replace(step.params, seed=2) == student.params for step in teachers)
    assert all(step.upstream == (found.scene,) for step in teachers)
    assert pseudo.upstream == (found.scene, *teachers)
    assert pseudo.params == PseudoParams(views=2, most=50, seed=2)
    assert student.upstream == (found.scene, pseudo)
    for reader in (found.render, found.evaluate):
        assert not {*found.distill} & {*reader.upstream}
    assert {*found.distill} <= {*found.report.upstream}


def test_a_run_without_teachers_is_what_it_was():
    assert keys(graph(*PLAIN)) == keys(graph(*PLAIN, "distill.views=5", "distill.preset=standard"))
    assert graph(*PLAIN).distill == ()
    assert not any(key.startswith("distill.") for key in shown_values(compose(PLAIN)[0]))
    assert shown_values(compose([*PLAIN, "distill.teachers=2"])[0])["distill.teachers"] == 2


def test_teachers_have_the_recipe_of_their_preset_with_the_words_of_the_run():
    words = ("scene=toycar", "method=2dgs", "preset=standard", "distill.teachers=2", "distill.preset=quick")
    more = ("method.loss.normal=0.01", "steps_scaler=0.5", "watch.steps=[100]")
    found = graph(*words, *more)
    alone = graph("scene=toycar", "method=2dgs", "preset=quick", "scene.long_side=800", "seed=1000", *more[:2])
    assert alone.scene.fingerprint == found.scene.fingerprint
    assert found.distill[0].params == alone.training[0].params
    assert (found.distill[0].params.schedule.total, found.training[0].params.schedule.total) == (1000, 2000)
    assert found.distill[0].params.method.loss.normal == found.training[0].params.method.loss.normal == 0.01
    assert found.distill[0].params.watch != found.training[0].params.watch


def test_an_ablation_is_of_teachers_too():
    words = ("scene=toycar", "method=3dgs", "ablation=no_dssim")
    found = graph(*words, "preset=standard", "distill.teachers=2", "distill.preset=quick")
    alone = graph(*words, "preset=quick", "scene.long_side=800", "seed=1000")
    assert found.distill[0].params == alone.training[0].params
    assert found.distill[0].params.method.loss.dssim == 0


def test_a_method_of_several_stages_is_refused():
    with pytest.raises(RtgsError, match=r"rtgs trains in several stages \(diffuse, reflection, transmittance\)"):
        graph(*GLASS, "distill.teachers=2")


def test_pictures_of_another_program_are_taught_by_nobody(tmp_path: Path):
    Image.new("RGB", (4, 4)).save(tmp_path / "view.png")
    words = ["scene=toycar", "method=external", "distill.teachers=2", f"external.renders={tmp_path}"]
    assert graph(*words).distill == ()
    assert not any(key.startswith("distill.") for key in shown_values(compose(words)[0]))


@pytest.mark.parametrize(
    "words",
    [
        ("schedule={total:60}", "method={loss:{dssim:0.1}}"),
        ("schedule.total=60", "++method.loss.dssim=0.1"),
    ],
)
def test_however_words_are_written_they_reach_the_teachers(words: tuple[str, str]):
    found = graph(*PLAIN, "distill.teachers=2", *words)
    for step in (found.distill[0], found.training[0]):
        assert step.params.schedule.total == 60
        assert step.params.method.loss.dssim == 0.1


def test_an_experiment_is_of_teachers_too(tmp_path: Path):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text("# @package _global_\nmethod:\n  loss:\n    dssim: 0.05\n")
    with with_configs(tmp_path):
        found = graph(*PLAIN, "experiment=mine", "distill.teachers=2")
    assert found.distill[0].params.method.loss.dssim == found.training[0].params.method.loss.dssim == 0.05


def test_a_preset_of_a_folder_of_ones_own_teaches_in_a_plan(tmp_path: Path, capsys):
    (tmp_path / "preset").mkdir()
    (tmp_path / "preset" / "mine.yaml").write_text("# @package _global_\ndefaults:\n  - quick\n  - _self_\n")
    words = ["--config-dir", str(tmp_path), *PLAIN, "distill.teachers=2", "distill.preset=mine"]
    assert plan_of_words(words) == 0
    assert "teacher_2" in capsys.readouterr().out
    assert any(step.name == "teacher_1" for step in steps_of_words(words))


def test_a_teacher_is_expected_to_take_as_long_as_what_it_teaches(tmp_path: Path):
    found = graph(*PLAIN, "distill.teachers=2")
    expected = Expectation(Store(tmp_path))
    assert expected.seconds(found.distill[0]) == expected.seconds(found.training[0]) > 0


def test_a_judge_compares_the_taught_method():
    found = graph(*PLAIN[:2], "preset=smoke", "method=2dgs", "judge=photos", "distill.teachers=2")
    pseudo = found.distill[-1]
    *until, rest = found.training
    assert all(pseudo in step.upstream for step in (*until, rest))
    assert pseudo not in found.judge[0].upstream
    assert found.distill[0].params.method.appearance == until[0].params.method.appearance


@pytest.mark.parametrize("teachers", [-1, 1, 10])
def test_a_number_of_teachers_that_teaches_nothing_is_refused(teachers: int):
    with pytest.raises(RtgsError, match=r"distill\.teachers"):
        compose([*PLAIN, f"distill.teachers={teachers}"])


@pytest.mark.parametrize("word", ["distill.views=0", "distill.most=0"])
def test_no_picture_is_refused(word: str):
    with pytest.raises(RtgsError, match=word.split("=")[0]):
        compose([*PLAIN, word])


def test_a_preset_that_has_nothing_of_the_method_teaches_nothing():
    with pytest.raises(RtgsError, match=r"distill\.preset=paper_synthetic has nothing of method 3dgs"):
        compose([*PLAIN, "distill.teachers=2", "distill.preset=paper_synthetic"])


def test_a_preset_that_is_none_is_told():
    with pytest.raises(Exception, match="preset"):
        graph(*PLAIN, "distill.teachers=2", "distill.preset=none_such")
