"""The jobs of a sweep as `rtgs plan --multirun` composes them, beside what Hydra composes for each of them."""

from __future__ import annotations

import pytest
from hydra.errors import HydraException

from rtgs.config import compose
from rtgs.config.explain import explain
from rtgs.config.sweep import compose_jobs
from rtgs.core.errors import RtgsError


@pytest.mark.parametrize(
    "words",
    [
        ["scene=fox", "method=2dgs,rtgs", "preset=paper", "seed=0,1", "method.paper_schedule.total=77"],
        ["scene=fox,sedan", "preset=smoke", "ablation=none,no_dssim", "threads=1", "method.loss.l1=0.5,0.25"],
        ["scene=fox", "++method.init.sh_degree=1", "schedule.total=1000,2000"],
    ],
)
def test_a_job_is_what_hydra_composes_for_its_words(words):
    jobs, sweep = compose_jobs(words, multirun=True)
    assert sweep
    for job in jobs:
        config, choices = compose(job.words)
        assert (job.config, job.choices) == (config, choices)


def test_what_a_word_takes_from_the_config_is_of_its_job():
    jobs, _ = compose_jobs(
        ["scene=fox,sedan", "method=external", "external.name=n", "external.renders=/x/${scene.name}"], multirun=True
    )
    found = [job.config.external.renders for job in jobs if job.config is not None]
    assert found == ["/x/fox", "/x/sedan"]


def test_jobs_come_in_hydras_order():
    jobs, _ = compose_jobs(["seed=0,1", "scene=fox,sedan"], multirun=True)
    assert [job.title for job in jobs] == [
        "fox-rtgs-quick",
        "sedan-rtgs-quick",
        "fox-rtgs-quick-seed1",
        "sedan-rtgs-quick-seed1",
    ]


def test_an_experiment_that_sweeps_is_a_sweep_without_the_option():
    jobs, sweep = compose_jobs(["experiment=table1", "scene=fox,bonsai", "method=2dgs"], multirun=False)
    assert sweep
    assert [job.title for job in jobs] == [
        "fox-2dgs-quick",
        "bonsai-2dgs-quick",
    ]
    config, choices = compose(["experiment=table1", "scene=fox", "method=2dgs"])
    assert (jobs[0].config, jobs[0].choices.experiment) == (config, choices.experiment)


def test_a_single_run_is_one_job():
    (job,), sweep = compose_jobs(["scene=fox", "seed=3"], multirun=False)
    assert not sweep
    assert (job.config, job.choices) == compose(["scene=fox", "seed=3"])


def test_a_job_whose_values_do_not_fit_says_so_and_leaves_the_others_alone():
    jobs, _ = compose_jobs(["scene=fox", "method=2dgs,3dgs", "ablation=no_normal_loss"], multirun=True)
    assert jobs[0].config is not None
    assert jobs[1].config is None
    assert "takes nothing away from method 3dgs" in jobs[1].problem
    assert "method=3dgs" in jobs[1].title


@pytest.mark.parametrize(
    ("word", "expected"),
    [("method.los.l1=1,2", "Key 'los'"), ("method.loss.l1=a,b", "could not be converted"), ("scene=nope,fox", "nope")],
)
def test_a_mistake_stops_the_sweep_as_hydra_does(word, expected):
    with pytest.raises(HydraException) as raised:
        compose_jobs(["scene=fox", word], multirun=True)
    assert expected in explain(raised.value)


def test_sweeping_without_the_option_is_refused():
    with pytest.raises(HydraException, match="--multirun"):
        compose_jobs(["seed=0,1"], multirun=False)


def test_only_the_basic_sweeper_is_known():
    with pytest.raises(RtgsError, match="basic sweeper"):
        compose_jobs(["hydra.sweeper._target_=other.Sweeper", "seed=0,1"], multirun=True)
