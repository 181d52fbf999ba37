from __future__ import annotations

import sys
from dataclasses import replace

import pytest
from accept_steps import LOCK_FILE

from pipelines.planning.graph import KINDS
from rtgs.core.errors import RtgsError
from rtgs.workflow import StepKind
from rtgs.workflow.sources import accept_sources, check_sources, source_hash


def test_no_step_changed_without_a_new_version():
    assert check_sources(KINDS, LOCK_FILE) == []


@pytest.fixture
def kind(tmp_path, monkeypatch) -> StepKind:
    (tmp_path / "guarded_step.py").write_text('"""Doc."""\n\ndef work(params, context):\n    return 1  # one\n')
    (tmp_path / "guarded_helper.py").write_text("BORDER = 3\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "guarded_step", raising=False)
    import guarded_step  # pyright: ignore[reportMissingImports]

    return StepKind("guarded", 1, guarded_step.work, helpers=("guarded_helper",))


def test_comments_blanks_and_docstrings_do_not_count(kind, tmp_path):
    before = source_hash(kind)
    (tmp_path / "guarded_step.py").write_text('def work(params, context):\n\n    """New."""\n    return 1\n')
    assert source_hash(kind) == before


@pytest.mark.parametrize("file", ["guarded_step.py", "guarded_helper.py"])
def test_a_change_of_the_step_or_its_helper_is_caught(kind, tmp_path, file):
    lock = tmp_path / "lock.json"
    assert check_sources([kind], lock) == ["step guarded is new: run `make accept-steps`"]
    accept_sources([kind], lock)
    assert check_sources([kind], lock) == []
    (tmp_path / file).write_text((tmp_path / file).read_text().replace("1", "2").replace("3", "4"))
    assert check_sources([kind], lock) == ["source of step guarded changed: bump version or run `make accept-steps`"]
    bumped = replace(kind, version=2)
    assert check_sources([bumped], lock) == ["version of step guarded is 2, recorded 1: run `make accept-steps`"]
    accept_sources([bumped], lock)
    assert check_sources([bumped], lock) == []
    assert check_sources([], lock) == ["step guarded is gone: run `make accept-steps`"]


def test_the_kernels_of_a_native_package_count_without_their_comments(kind, tmp_path):
    package = tmp_path / "guarded_native"
    package.mkdir()
    (package / "__init__.py").write_text("")
    kernel = package / "kernel.cpp"
    kernel.write_text("// One.\nfloat f() { return 1.f; }  /* two\n lines */\n")
    native = replace(kind, helpers=("guarded_native",))
    before = source_hash(native)
    kernel.write_text("float f() {\n  return 1.f;\n}\n")
    assert source_hash(native) == before
    kernel.write_text("float f() { return 2.f; }")
    assert source_hash(native) != before


def test_training_rendering_and_meshing_depend_on_the_kernels():
    assert {kind.name for kind in KINDS if "rtgs.native" in kind.helpers} >= {"train_diffuse", "render", "extract_mesh"}


def test_a_helper_that_does_not_exist_is_named(kind):
    with pytest.raises(RtgsError, match=r"step guarded declares the helper module 'guarded_nothing'"):
        source_hash(replace(kind, helpers=("guarded_nothing",)))
