"""README's commands hold on a clean clone: they name what is in the tree, and need no capture that is not shipped."""

from __future__ import annotations

import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import pytest

from pipelines.cli.main import COMMANDS
from rtgs.config import compose
from rtgs.config.sweep import compose_jobs
from rtgs.config.words import friendly_overrides
from rtgs.fetch.catalogue import capture_names

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CHOICES = (ROOT / "docs" / "choices.md").read_text(encoding="utf-8")
EMBEDDED = "embedded:"


def commands(text: str) -> list[list[str]]:
    """Of the blocks marked ``bash``, without comments, lines that end in a backslash joined."""
    blocks = re.findall(r"^```bash\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def scenes_of(words: list[str]) -> list[str]:
    """Paths of the scenes that a command of ``rtgs`` composes."""
    asked = friendly_overrides([word for word in words if word != "--multirun"])
    if "--multirun" in words:
        jobs, _ = compose_jobs(asked, multirun=True)
        return [str(job.config.scene.path) for job in jobs]
    return [str(compose(asked)[0].scene.path)]


def test_there_are_commands():
    assert len(commands(README)) >= 7
    assert commands("```bash\nmake a \\\n  b  # c\n```\n") == [["make", "a", "b"]]


@pytest.mark.parametrize("words", commands(README) + commands(CHOICES), ids=" ".join)
def test_a_command_names_what_is_in_the_tree(words):
    program, *rest = words
    if program == "make":
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        assert re.search(rf"^{rest[0]}:", makefile, re.MULTILINE)
    elif program.endswith("python"):
        if rest[0] == "-m":
            assert find_spec(rest[1])
        else:
            assert (ROOT / rest[0]).is_file()
    else:
        assert program in (".venv/bin/rtgs", "rtgs")
        assert rest[0] in COMMANDS
        if rest[0] in ("run", "plan", "check"):
            assert all(path.startswith(EMBEDDED) for path in scenes_of(rest[1:]))


def choices_of(group: str) -> set[str]:
    return {path.stem for path in (ROOT / "conf" / group).glob("*.yaml")}


def test_every_method_of_the_tree_is_in_the_table():
    table = README.partition("| `method=` |")[2].partition("\n\n")[0]
    first_cells = [line.split("|")[1] for line in table.splitlines() if line.count("|") > 2]
    assert choices_of("method") == set(re.findall(r"`(\w+)`", "".join(first_cells)))


@pytest.mark.parametrize("group", ["ablation", "masks", "normals", "sfm", "judge", "preset"])
def test_every_choice_of_a_group_is_in_the_table(group):
    (row,) = [line for line in CHOICES.splitlines() if line.startswith(f"| `{group}=` |")]
    assert choices_of(group) - {"none"} <= set(re.findall(r"`(\w+)`", row))


def test_words_are_explained_where_they_are_first_used():
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", README, flags=re.DOTALL)
    prose = re.sub(r"^\|.*$", "", prose, flags=re.MULTILINE)
    for word in ("Gaussians", "ellipsoids", "surfels", "preset", "stand-ins"):
        first = re.search(rf"\b{word}\b", prose)
        assert first is not None
        assert prose[first.start() - 1] == "*", word


def test_captures_that_are_named_can_be_got():
    for name in re.findall(r"rtgs get (\w+)", README + (ROOT / "docs" / "captures.md").read_text(encoding="utf-8")):
        assert name in capture_names()


def test_the_citation_has_the_version_and_the_paper():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    version = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
    assert version is not None
    assert f"version: {version[1]}" in text
    (paper,) = re.findall(r"https://arxiv\.org/abs/[\d.]+", README)
    assert paper in text
