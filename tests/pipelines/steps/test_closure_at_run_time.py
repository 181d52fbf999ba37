"""What steps really load when they run is what the guard says they reach."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from test_transmittance_stage import TINY, write_capture

from pipelines.planning.graph import KINDS, build_graph
from rtgs.config import compose
from rtgs.workflow import Step, Store, make_plan
from tests.pipelines.accept_steps import PACKAGES, ROOT, project
from tests.pipelines.app_cases import QUICK

CHILD = """
import json, logging, pickle, sys
from pathlib import Path

run, params, inputs, out, partial, packages = pickle.loads(Path(sys.argv[1]).read_bytes())
from rtgs.track.null import NullTracker
from rtgs.workflow.step import StepContext

run(params, StepContext(inputs, out, partial, logging.getLogger("rtgs"), NullTracker()))
print(json.dumps(sorted(name for name in sys.modules if name.split(".")[0] in packages)))
"""
COUNTED_ELSEWHERE = {"rtgs.native._core"}  # built from the C++ sources, which the package declares


@pytest.fixture(scope="module")
def loaded(tmp_path_factory) -> dict[str, set[str]]:
    """Modules of the project by step, each step of a run of three stages in a process of its own."""
    folder = tmp_path_factory.mktemp("closure")
    capture = write_capture(folder / "glass ball", "ball")
    words = ["scene=capture", f"scene.path={capture}", "method=rtgs", "masks=given", *QUICK, *TINY]
    store = Store(folder / "store")
    plan = make_plan(build_graph(*compose(words)).targets, store)
    return {planned.step.name: _modules_of(planned.step, store, folder / "step.pickle") for planned in plan}


def _modules_of(step: Step, store: Store, message: Path) -> set[str]:
    attempt, partial = store.new_attempt(step.name, step.fingerprint), store.partial(step)
    partial.mkdir(parents=True)
    inputs = {other.name: store.folder(other) for other in step.upstream}
    message.write_bytes(pickle.dumps((step.run, step.params, inputs, attempt, partial, PACKAGES)))
    words = [sys.executable, "-c", CHILD, str(message)]
    alone = os.environ | {"OMP_NUM_THREADS": "1"}  # tiny tensors: more threads than cores would wait for each other
    result = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT, env=alone)
    assert result.returncode == 0, result.stderr
    store.publish(step, attempt, 0.0)
    return set(json.loads(result.stdout.splitlines()[-1]))


def test_no_step_loads_a_module_that_its_closure_lacks(loaded: dict[str, set[str]]):
    tree = project()
    kinds = {kind.name: kind for kind in KINDS}
    ran = {*loaded}
    assert ran >= {"masks", "import_scene", "train_diffuse", "train_reflection", "train_transmittance"}
    assert ran >= {"extract_mesh", "render", "evaluate", "report"}
    missing = {}
    for name, modules in loaded.items():
        assert len(modules) > 20
        closure = tree.closure(kinds[name].run.__module__)
        files = {module: tree.file_of(module) for module in modules - COUNTED_ELSEWHERE}
        missing[name] = sorted(
            module for module, file in files.items() if file not in closure and not _is_folder(module)
        )
    assert {name: modules for name, modules in missing.items() if modules} == {}


def _is_folder(module: str) -> bool:
    """A package without ``__init__`` has no source of its own."""
    return project().file_of(module) is None and (ROOT / module.replace(".", "/")).is_dir()


def test_what_is_loaded_late_is_loaded_here(loaded: dict[str, set[str]]):
    """Otherwise the comparison above would show nothing about imports inside functions."""
    assert "rtgs.report.page" in loaded["report"]
    assert {"rtgs.methods.rtgs", "rtgs.train.trainer"} <= loaded["train_diffuse"]
    assert "rtgs.report.page" not in loaded["render"]
