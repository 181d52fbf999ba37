"""A method from outside the package, two stages, on a worker process that is killed: the artifact of one process."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch
import two_stage_method
from app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)
from safetensors.torch import load_file

from pipelines.planning.graph import RunGraph, build_graph
from pipelines.steps.training import read_summary
from rtgs.config import compose
from rtgs.methods import Mode
from rtgs.methods.model import Model
from rtgs.runs.training import load_method
from rtgs.runs.views import read_render
from rtgs.scenes.canonical import read_scene
from rtgs.workflow import InlineExecutor, Store, make_plan
from rtgs.workflow.engine import DaskExecutor, EngineSettings, open_client
from rtgs.workflow.worker import WorkerJob

NAME = "two_stage_method:SPEC"
STATE = Path("checkpoint") / "state.safetensors"


@pytest.fixture(scope="module")
def graph(capture: Path) -> RunGraph:  # noqa: F811
    words = ["scene=capture", f"scene.path={capture}", "method=2dgs", f"method.name='{NAME}'", *QUICK]
    return build_graph(*compose([*words, "schedule.checkpoint_every=3"]))


@pytest.fixture(scope="module")
def here(graph: RunGraph, tmp_path_factory) -> Store:
    """Everything made in this process, without a break."""
    torch.set_num_threads(1)
    store = Store(tmp_path_factory.mktemp("here") / "store")
    InlineExecutor(store).execute(make_plan([graph.render], store))
    return store


@pytest.fixture(scope="module")
def there(graph: RunGraph, tmp_path_factory) -> Store:
    """The same on a worker, which is killed in the second stage and replaced."""
    folder = tmp_path_factory.mktemp("there")
    store, marker = Store(folder / "store"), folder / "kills"
    marker.touch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(Path(two_stage_method.__file__).parent), *sys.path]))
        patch.setenv("EXPOSURE_KILLS", str(marker))
        with open_client(EngineSettings(workers=1, threads=1)) as client:
            outcomes = DaskExecutor(client, WorkerJob(str(store.root), 1)).attempt(make_plan([graph.render], store))
    assert not outcomes.failures
    assert not marker.exists(), "the worker was killed"
    return store


def test_its_second_stage_is_a_step_of_its_own(graph: RunGraph):
    assert [step.name for step in graph.training] == ["train_diffuse", "train_exposed"]
    assert [(step.params.from_step, step.params.until) for step in graph.training] == [(0, 6), (6, 12)]
    assert all(name == "method late_exposure" for step in graph.training for name, _ in step.tools)


def test_a_killed_worker_goes_on_and_ends_with_the_same_artifacts(graph: RunGraph, here: Store, there: Store):
    resumed = [read_summary(store.folder(graph.training[1])).resumed_from for store in (here, there)]
    assert resumed == [6, 9], "the state of the stage before; a checkpoint with the gains in it"
    for step in graph.training:
        ours, theirs = (store.folder(step) for store in (here, there))
        for name in (STATE, Path("base.ply")):
            assert (ours / name).read_bytes() == (theirs / name).read_bytes(), (step.name, name)
    pictures = sorted(path.name for path in (here.folder(graph.render) / "views").iterdir())
    assert len(pictures) == 2
    for name in pictures:
        ours, theirs = (store.folder(graph.render) / "views" / name for store in (here, there))
        assert ours.read_bytes() == theirs.read_bytes(), name


def test_the_group_begins_with_the_second_stage_and_is_loaded_from_there(graph: RunGraph, there: Store):
    scene = read_scene(there.folder(graph.scene))
    first, second = (there.folder(step) for step in graph.training)
    assert not [name for name in load_file(first / STATE) if "exposure" in name]
    method, params = load_method(second, scene)
    assert isinstance(method, Model)
    (group,) = method.groups
    assert (params.until, group.steps) == (12, 6)
    assert float((group["gain"].detach() - 1).abs().min()) > 1e-3, "all three have moved"
    plain, _ = load_method(first, scene)
    assert isinstance(plain, Model)
    assert plain.groups == ()
    view = scene.test[0]
    with torch.no_grad():
        image = method.render(view.camera, params.until, Mode.EVALUATE).image
    assert torch.equal(image, read_render(there.folder(graph.render), view.name)["image"])
