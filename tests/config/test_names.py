"""Names of runs: two runs that differ have two names, and a person reads what differs."""

from __future__ import annotations

from rtgs.config import compose
from rtgs.config.keys import config_keys, short_key
from rtgs.config.names import LONGEST_OVERRIDES, overridden
from rtgs.config.sweep import compose_jobs


def name_of(*words: str) -> str:
    return str(compose(list(words))[0].name)


def test_a_name_carries_what_was_overridden():
    assert name_of("scene=fox") == "fox-rtgs-quick"
    assert name_of("scene=fox", "method.loss.dssim=0.1") == "fox-rtgs-quick-dssim_0.1"
    assert name_of("scene=fox", "schedule.total=300", "seed=2", "scene.long_side=80") == (
        "fox-rtgs-quick-seed2-scene.long_side_80-schedule.total_300"
    )
    assert name_of("scene=fox", "masks=none") == "fox-rtgs-quick-masks_none"


def test_where_results_go_is_no_part_of_it():
    words = (
        "threads=1",
        "processes=2",
        "tracking=off",
        "tracking.experiment=mine",
        "paths.remote=/x",
        "table.name=t",
        "judge=none",
    )
    assert name_of("scene=fox", *words) == "fox-rtgs-quick"


def test_runs_of_other_programs_are_told_apart():
    row = "fox-external-quick-renders_"
    mine, other = ("external.renders=/my/a", "external.renders=/my/b")
    assert name_of("scene=fox", "method=external", mine).startswith(f"{row}_my_a")
    names = {
        name_of("scene=fox", "method=external", *words)
        for words in (
            [mine],
            [other],
            [mine, "external.colors=linear"],
            [mine, "external.colors=srgb"],
            [mine, "external.larger=shrink"],
            [mine, "external.layers=/my/a"],
            [mine, "external.layers=/my/b"],
        )
    }
    assert len(names) == 7
    named = [name_of("scene=fox", "method=external", each, "external.name=Mine") for each in (mine, other)]
    assert named == ["fox-external_Mine-quick"] * 2
    assert name_of("scene=fox", mine) == "fox-rtgs-quick"


def test_jobs_of_a_sweep_over_a_key_have_names_of_their_own():
    jobs, _ = compose_jobs(["scene=fox", "method.loss.dssim=0.1,0.3"], multirun=True)
    assert [job.title for job in jobs] == ["fox-rtgs-quick-dssim_0.1", "fox-rtgs-quick-dssim_0.3"]


def test_the_order_of_words_does_not_matter():
    assert overridden(["seed=1", "b.c=2", "a=1"]) == overridden(["a=1", "+b.c='2'"]) == "a_1-b.c_2"


def test_what_a_name_cannot_hold_is_told_apart_by_a_digest():
    one, other = overridden(["masks.file=/a/b.yaml"]), overridden(["masks.file=_a_b.yaml"])
    assert one != other
    assert one.startswith("masks.file__a_b.yaml-") or one.startswith("file__a_b.yaml-")
    assert overridden(["x=-1"]) != overridden(["x=1"])
    many = [f"key{k}=value_{k}" for k in range(20)]
    long, longer = overridden(many), overridden([*many[:-1], "key19=other"])
    assert long != longer
    assert long.rsplit("-", 1)[0] == longer.rsplit("-", 1)[0]
    assert len(long) <= LONGEST_OVERRIDES + 7
    assert "/" not in overridden(["a=x/y", "b=[1,2]"])


def test_a_short_key_is_that_of_one_key():
    keys = config_keys()
    assert {"scene.path", "method.loss.dssim", "seed", "schedule.total"} <= set(keys)
    short = [short_key(name) for name in keys]
    assert len(set(short)) == len(keys)
    for name, brief in zip(keys, short):
        assert f".{name}".endswith(f".{brief}")
        assert brief == name or sum(f".{other}".endswith(f".{brief}") for other in keys) == 1


def test_of_a_key_that_is_given_twice_the_last_value_counts():
    assert overridden(["a=2", "a=1"]) == "a_1"
