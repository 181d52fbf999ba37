"""Networks of the perceptual loss and of LPIPS: what the key of a training names, and workers that lack them."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from pipelines.planning.graph import RunGraph, build_graph
from pipelines.steps.train import train_step
from rtgs.config import compose
from rtgs.methods import find_method
from rtgs.methods.settings import MethodSettings
from rtgs.pretrained import weights
from rtgs.pretrained.weights import LPIPS_VGG, VGG16
from rtgs.runs.training import StageParams
from rtgs.train.settings import LossSettings
from rtgs.workflow import InlineExecutor, Store, make_plan
from rtgs.workflow.worker import WorkerJob, run_step
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)
from tests.train.training_cases import small_schedule

BOTH = (("lpips_vgg", LPIPS_VGG.sha256), ("vgg16", VGG16.sha256))
WORDS = ("method=rtgs", *QUICK, "method.reflection.cells=3", "method.reflection.matte.probation=0")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The one folder of weights of this machine."""
    monkeypatch.setattr(weights, "weight_folders", lambda: (tmp_path / "weights",))
    return tmp_path / "weights"


def put(folder: Path, *files: weights.PretrainedFile) -> None:
    for file in files:
        (folder / file.filename).parent.mkdir(parents=True, exist_ok=True)
        (folder / file.filename).write_bytes(b"a stand-in: only looked for")


def graph_of(capture: Path, *words: str) -> RunGraph:  # noqa: F811
    return build_graph(*compose(["scene=capture", f"scene.path={capture}", *WORDS, *words]))


def keys(graph: RunGraph) -> list[str]:
    return [step.fingerprint for step in graph.training]


def test_networks_belong_to_the_recipe_where_the_loss_reads_them():
    spec = find_method("rtgs")
    for weight, form, named in ((0.0, "lpips", ()), (0.01, "lpips", BOTH), (0.01, "vgg16_l1", BOTH[1:])):
        method = MethodSettings(name="rtgs", loss=LossSettings(perceptual=weight, perceptual_form=form))
        params = StageParams(method, small_schedule(30), 0, "reflection", 10, 30)
        bare, whole, half = (train_step(spec, params, networks=found) for found in ((), BOTH, BOTH[:1]))
        assert (bare.tools, whole.tools, half.tools) == ((), named, ())
        assert bare.fingerprint == half.fingerprint
        assert (bare.fingerprint == whole.fingerprint) is (named == ())


def test_a_key_counts_only_the_files_that_the_form_reads(capture: Path, here: Path):  # noqa: F811
    forms = ("method.loss.perceptual_form=lpips", "method.loss.perceptual_form=vgg16_l1")
    found = []
    for files in ((), (VGG16,), (LPIPS_VGG,)):  # each comes to those before
        put(here, *files)
        found.append([keys(graph_of(capture, form)) for form in forms])
    (bare_lpips, bare_l1), (half_lpips, half_l1), (whole_lpips, whole_l1) = found
    assert bare_lpips == half_lpips
    assert bare_lpips[0] == whole_lpips[0], "the first stage has no such loss"
    assert bare_lpips[1] != whole_lpips[1]
    assert bare_l1[1] != half_l1[1]
    assert half_l1 == whole_l1


def test_a_worker_without_the_networks_of_the_key_does_not_train(capture: Path, here: Path, tmp_path: Path, caplog):  # noqa: F811
    put(here, VGG16, LPIPS_VGG)
    _, second = graph_of(capture).training
    store = Store(tmp_path / "store")
    InlineExecutor(store).execute(make_plan(second.upstream, store))
    for file in (VGG16, LPIPS_VGG):
        (here / file.filename).unlink()  # as on another machine
    with caplog.at_level(logging.INFO):
        outcome = run_step(second, WorkerJob(str(store.root), 1), [])
    assert outcome.failed
    for part in ("MissingWeights: the key of this step names the network vgg16", f"searched {here}", "RTGS_WEIGHTS"):
        assert part in outcome.problem
    assert store.find(second) is None
    assert not store.partial(second).exists(), "nothing was trained"


def test_a_worker_with_other_networks_than_the_key_s_does_not_measure(
    capture: Path,  # noqa: F811
    here: Path,
    tmp_path: Path,
):
    bare = graph_of(capture, "method=2dgs").evaluate
    put(here, VGG16, LPIPS_VGG)
    whole = graph_of(capture, "method=2dgs").evaluate
    assert bare.fingerprint != whole.fingerprint
    store = Store(tmp_path / "store")
    InlineExecutor(store).execute(make_plan(whole.upstream, store))
    job = WorkerJob(str(store.root), 1)
    outcome = run_step(bare, job, [])
    assert outcome.failed
    assert "WrongWeights: the key of this step names no network of LPIPS (evaluation.lpips=true)" in outcome.problem
    for file in (VGG16, LPIPS_VGG):
        (here / file.filename).unlink()  # as on another machine
    outcome = run_step(whole, job, [])
    assert outcome.failed
    for part in ("the key of this step names the network vgg16", f"searched {here}", "set evaluation.lpips=false"):
        assert part in outcome.problem
    assert [store.find(step) for step in (bare, whole)] == [None, None], "no table without its figures is stored"
    assert not run_step(bare, job, []).failed
