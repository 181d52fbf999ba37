from __future__ import annotations

from dataclasses import make_dataclass, replace

import numpy as np
import pytest
from toy import ToyParams, graph, train

from rtgs.core.errors import RtgsError
from rtgs.workflow import InlineExecutor, Step, Store, make_plan
from rtgs.workflow.manifest import describe
from rtgs.workflow.plan import NEW_INPUT, Neighbours, differences, topological


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path / "store")
    InlineExecutor(store).execute(make_plan(graph(tmp_path), store))
    return store


def test_upstream_comes_first_and_shared_steps_once(tmp_path):
    steps = topological(graph(tmp_path) + graph(tmp_path, (0.1, 0.9)))
    assert [step.name for step in steps] == ["prep", "geom", "train", "train", "train", "train"]


def test_everything_is_missing_at_first(tmp_path):
    plan = make_plan(graph(tmp_path), Store(tmp_path / "empty"))
    assert (plan.hits, len(plan)) == (0, 5)
    assert {planned.reason for planned in plan} == {"never ran here"}


def test_a_miss_is_explained_by_the_nearest_artifact(tmp_path, store):
    target = graph(tmp_path, (0.4,))[0]
    plan = make_plan([target], store)
    assert [planned.hit for planned in plan] == [True, True, False]
    assert plan.steps[2].reason in {f"value: {old} -> 0.4" for old in (0.1, 0.2, 0.3)}


def test_version_and_upstream_changes_are_named(tmp_path, store):
    target = graph(tmp_path)[0]
    bumped = replace(target.upstream[0], version=2)
    plan = make_plan([replace(target, upstream=(bumped,))], store)
    assert [planned.reason for planned in plan] == ["", "step version: 1 -> 2", "upstream geom changed"]


def test_tools_are_part_of_the_recipe(tmp_path, store):
    step = graph(tmp_path)[0]
    newer = Step("train", 1, step.params, train, step.upstream, (("solver", "4.2"),))
    assert newer.fingerprint != step.fingerprint
    assert make_plan([newer], store).steps[-1].reason == "solver: absent -> 4.2"


def test_a_damaged_artifact_is_told_as_one(tmp_path, store):
    """Not as the difference to another one, nor as never made."""
    target, other = graph(tmp_path)[:2]
    (store.folder(target) / "result.txt").unlink()
    plan = make_plan([target, other], store)
    assert [planned.reason for planned in plan] == ["", "", "its artifact is damaged", ""]


def test_numbers_of_another_kind_are_another_recipe(tmp_path, store):
    whole = Step("train", 1, ToyParams(1), train)  # pyright: ignore[reportArgumentType]
    assert differences(whole, describe(Step("train", 1, ToyParams(1.0), train), tmp_path, 1.0, "")) == [
        "value: 1.0 -> 1"
    ]


def test_a_checkpoint_is_announced(tmp_path, store):
    step = Step("train", 1, ToyParams(5.0), train, graph(tmp_path)[0].upstream)
    store.partial(step).mkdir(parents=True)
    assert make_plan([step], store).steps[-1].reason.endswith("resumes from its checkpoint")


def test_the_nearest_artifact_has_the_fewest_differences(tmp_path):
    names = ("a", "b", "c", "d")
    random = np.random.default_rng(5)

    def step(values) -> Step:
        params = make_dataclass("Drawn", [(name, int) for name in names], frozen=True)(*map(int, values))
        return Step("train", 1, params, train)

    cached = [describe(step(random.integers(0, 3, 4)), tmp_path, 1.0, "") for _ in range(30)]
    neighbours = Neighbours(cached)
    for _ in range(30):
        missing = step(random.integers(0, 4, 4))
        fewest = min(len(differences(missing, manifest)) for manifest in cached)
        assert neighbours.explain_miss(missing).count("->") == min(fewest, 3)


def test_an_empty_graph_is_refused(store):
    with pytest.raises(RtgsError, match="no target"):
        make_plan([], store)


def test_planning_a_thousand_cached_steps_is_quick(tmp_path):
    import time

    store = Store(tmp_path / "store")
    steps = [Step("train", 1, ToyParams(float(i)), train) for i in range(1000)]
    for step in steps:
        folder = store.folder(step)
        folder.mkdir(parents=True)
        (folder / "manifest.json").write_text(
            f'{{"step": "train", "version": 1, "fingerprint": "{step.fingerprint}", "params": {{"value": 1.0}}, '
            '"upstream": {}, "tools": {}, "files": {}, "duration": 1.0, "created": "2026-01-01T00:00:00+00:00"}'
        )
    start = time.process_time()
    plan = make_plan(steps, store)
    assert plan.complete
    assert time.process_time() - start < 2.0


def test_a_new_capture_is_not_compared_with_another_one(tmp_path, store):
    """Neither are the steps that build on it; an edited capture of the same name is."""

    def steps(capture: str, name: str, value: float = 0.1) -> list[Step]:
        recipe = make_dataclass("Recipe", [("capture", str), ("settings", object)], frozen=True)
        naming = make_dataclass("Naming", [("name", str)], frozen=True)
        first = Step("read", 1, recipe(capture, naming(name)), write_nothing)
        return [
            first,
            Step("learn", 1, make_dataclass("Own", [("value", float)], frozen=True)(value), write_nothing, (first,)),
        ]

    InlineExecutor(store).execute(make_plan(steps("aa", "fox"), store))
    assert [each.reason for each in make_plan(steps("bb", "cat"), store)] == [NEW_INPUT, NEW_INPUT]
    assert [each.reason for each in make_plan(steps("bb", "fox"), store)] == [
        "capture: aa -> bb",
        "upstream read changed",
    ]
    assert [each.reason for each in make_plan(steps("aa", "fox", 0.2), store)] == ["", "value: 0.1 -> 0.2"]


def write_nothing(params, context) -> None:
    (context.out / "result.txt").write_text("")
