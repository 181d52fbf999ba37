"""Completion: what may follow which words, and the scripts in their shells."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pipelines.cli.complete import FILES, SCRIPTS, complete
from pipelines.cli.main import COMMANDS, main


@pytest.fixture
def root(tmp_path) -> Path:
    """With two finished runs and a folder that is none."""
    for name in ("fox-rtgs-quick", "fox-2dgs-quick"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "run.json").touch()
    (tmp_path / "runs" / "fox-unfinished").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ru", {"run"}),
        ("c", {"cache", "check", "completion"}),
        ("run met", {"method=", "method."}),
        ("run method=rt", {"method=rtgs", "method=rtgs_printed"}),
        ("run method=2dgs,en", {"method=2dgs,envgs"}),
        ("run method.loss.ds", {"method.loss.dssim="}),
        ("run +method.loss.ds", {"+method.loss.dssim="}),
        ("run schedule.tot", {"schedule.total="}),
        ("run mesh.source=h", {"mesh.source=hull"}),
        ("run mesh.extract=", {"mesh.extract=true", "mesh.extract=false"}),
        ("plan --mu", {"--multirun"}),
        ("run scene=/my/pho", {FILES}),
        ("run seed=", {FILES}),
        ("cache push scen", {"scene=", "scene."}),
        ("cache v", {"verify"}),
        ("show fox", {"fox-2dgs-quick", "fox-rtgs-quick"}),
        ("show fox-rtgs-quick layer=re", {"layer=reflection"}),
        ("show point_clo", {FILES}),
        ("report fox-r", {"fox-rtgs-quick"}),
        ("check scene=sph", {"scene=spheres"}),
        ("out", {"outline"}),
        ("outline scene=sph", {"scene=spheres"}),
        ("outline bott", {FILES}),
        ("get wall", {"wall_clock"}),
        ("get fox to=./he", {FILES}),
        ("completion z", {"zsh"}),
    ],
)
def test_what_may_follow(root, line, expected):
    assert set(complete(line.split(" "), list(COMMANDS), root)) == expected


def test_keys_come_level_by_level(root):
    found = complete(["run", "method."], list(COMMANDS), root)
    assert {"method.loss.", "method.name="} <= set(found)
    assert all(word.count(".") <= 2 for word in found)
    assert len(found) == len(set(found))
    top = complete(["run", ""], list(COMMANDS), root)
    assert {"scene=", "method=", "preset=", "seed=", "schedule."} <= set(top)


@pytest.fixture
def program(root, monkeypatch) -> Path:
    """``rtgs`` as an executable of a folder on the path."""
    folder = root / "bin"
    folder.mkdir()
    script = folder / "rtgs"
    script.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m rtgs "$@"\n')
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("RTGS_ROOT", str(root))
    return script


def in_bash(line: str) -> list[str]:
    """What bash offers for a line, as it would be put in the place of the word before the cursor."""
    code = f"""
    eval "$(rtgs completion bash)"
    COMP_LINE={shlex.quote(line)} COMP_POINT={len(line)} COMP_WORDBREAKS=$' \\t\\n"><=;|&(:'
    _rtgs
    printf '%s\\n' "${{COMPREPLY[@]}}"
    complete -p rtgs
    """
    told = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    assert told.stderr == ""
    *found, registered = told.stdout.splitlines()
    assert registered == "complete -F _rtgs rtgs"
    return [word for word in found if word]


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_bash_completes(program):
    assert in_bash("rtgs re") == ["report"]
    assert in_bash("rtgs run preset=qu") == ["quick"]  # '=' parts words there: what stands before it stays
    assert in_bash("rtgs run method.loss.ds") == ["method.loss.dssim="]
    assert sorted(in_bash("rtgs show ")[:2]) == ["fox-2dgs-quick", "fox-rtgs-quick"]
    assert in_bash("rtgs run scene=/no/such/fo") == []


@pytest.mark.skipif(shutil.which("zsh") is None, reason="no zsh here")
def test_zsh_takes_the_script(program):
    code = 'autoload -U compinit; compinit -u -D; eval "$(rtgs completion zsh)"; print $_comps[rtgs]'
    told = subprocess.run(["zsh", "-fc", code], capture_output=True, text=True, check=True)
    assert (told.stdout.strip(), told.stderr) == ("_rtgs", "")


@pytest.mark.skipif(shutil.which("fish") is None, reason="no fish here")
def test_fish_completes(program):
    code = "rtgs completion fish | source; complete -C 'rtgs run preset=qu'; complete -C 'rtgs re'"
    told = subprocess.run(["fish", "--no-config", "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["preset=quick", "report"]


def test_the_command_prints_the_scripts(capsys):
    for shell, script in SCRIPTS.items():
        assert main(["completion", shell]) == 0
        assert capsys.readouterr().out == script
    assert main(["completion", "tcsh"]) == 1
    assert "give one of bash, zsh, fish" in capsys.readouterr().err
