"""``rtgs view RUN`` and ``rtgs run ... view=true``: in headless Chromium where there is one, and what is refused."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from pipelines.cli.main import main
from pipelines.cli.view_run import ViewWords, parse_words, show, viewed
from rtgs.config import compose
from rtgs.core.errors import RtgsError
from rtgs.runs.record import RunRecord
from rtgs.runs.shown import open_run
from rtgs.workflow import Plan, PlannedStep, Step
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)
from tests.view import chromium
from tests.view.test_viewer import FakePage

REPOSITORY = Path(__file__).parents[3]
MIRROR = ("method=envgs", "method.reflection.start=0.25", "name=mirror", *QUICK)
# A training that waits at its first step until the page goes on.
WAITING = """
import sys
from pipelines.cli.main import main
from rtgs.view.page import ViserPage

class Waiting(ViserPage):
    def __init__(self, *given, **named):
        super().__init__(*given, **named)
        self.paused = True

import rtgs.view.page
rtgs.view.page.ViserPage = Waiting
sys.exit(main(sys.argv[1:]))
"""
needs_chromium = pytest.mark.skipif(chromium.browser() is None, reason="no Chromium (Debian: apt install chromium)")


@pytest.fixture(scope="module")
def run(root, capture) -> Path:
    """A run with reflections, from its third step on, that nobody looked at."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setenv("RTGS_ROOT", str(root))
        assert main(["run", f"scene={capture}", *MIRROR]) == 0
    return root / "runs" / "mirror"


def trained(folder: Path, root: Path) -> dict[str, torch.Tensor]:
    """All tensors at the end of a run."""
    record = RunRecord.read(folder)
    assert record is not None
    key = record.steps["train_reflection"]
    (file,) = (root / "store" / "train_reflection" / key[:2] / key / "checkpoint").glob("*.safetensors")
    return load_file(file)


def started(words: list[str], folder: Path, errors: Path) -> tuple[subprocess.Popen[bytes], str]:
    """A command in another process, and the address that it tells."""
    with errors.open("wb") as stream:
        process = subprocess.Popen(
            words, cwd=folder, stdout=stream, stderr=stream, env=os.environ | {"PYTHONPATH": str(REPOSITORY)}
        )
    end = time.monotonic() + 120
    while time.monotonic() < end and process.poll() is None:
        for word in errors.read_text().split():
            if word.startswith("http://127.0.0.1:"):
                return process, word
        time.sleep(0.1)
    process.kill()
    raise AssertionError(errors.read_text())


def press(tab: chromium.Tab, name: str) -> None:
    """A button, when it is there."""
    button = f"[...document.querySelectorAll('button')].find(each => each.innerText.trim() === {name!r})"
    tab.wait(button + " !== undefined")
    tab.evaluate(button + ".click()")


def switch(tab: chromium.Tab, name: str) -> None:
    """A switch, when it is there."""
    label = f"[...document.querySelectorAll('label')].find(each => each.innerText.trim() === {name!r})"
    tab.wait(label + " !== undefined")
    tab.evaluate(f"document.getElementById({label}.htmlFor).click()")


def changed(tab: chromium.Tab, before: np.ndarray) -> bool:
    """Whether the left part of the window, beside the switches, becomes another picture."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        left = slice(None), slice(0, before.shape[1] // 2)
        if np.abs(tab.picture()[left].astype(int) - before[left]).mean() > 1:
            return True
        time.sleep(0.2)
    return False


def settled(tab: chromium.Tab) -> np.ndarray:
    """The window when it shows the same twice."""
    tab.wait("document.body.innerText.includes('picture')")
    before = tab.picture()
    for _ in range(60):
        time.sleep(0.7)
        now = tab.picture()
        if (now == before).all():
            return now
        before = now
    raise AssertionError("the picture does not settle")


@needs_chromium
def test_a_layers_switch_changes_the_picture_of_a_run(run, tmp_path):
    pytest.importorskip("viser")
    words = [sys.executable, "-m", "rtgs", "view", str(run), "port=0", "threads=1"]
    process, address = started(words, run.parent.parent, tmp_path / "log")
    try:
        with chromium.open_tab(address, tmp_path / "profile") as tab:
            whole = settled(tab)
            switch(tab, "diffuse")
            assert changed(tab, whole)
            without = settled(tab)
            switch(tab, "diffuse")
            assert changed(tab, without)
            switch(tab, "cameras")
            tab.wait("document.body.innerText.includes('photos')")
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 128 + signal.SIGTERM


@needs_chromium
def test_a_training_in_the_browser_ends_bit_for_bit_as_without(run, root, capture, tmp_path):
    pytest.importorskip("viser")
    words = ["run", f"scene={capture}", *MIRROR, "view=true", "viewer.port=0", f"paths.root={tmp_path}"]
    process, address = started([sys.executable, "-c", WAITING, *words], root, tmp_path / "log")
    with chromium.open_tab(address, tmp_path / "profile") as tab:
        settled(tab)
        tab.wait("document.body.innerText.includes('paused')")
        press(tab, "Pause")
        assert process.wait(120) == 0, (tmp_path / "log").read_text()
    told = (tmp_path / "log").read_text()
    assert "paused in the viewer at step 1" in told
    assert "going on" in told
    found, expected = trained(tmp_path / "runs" / "mirror", tmp_path), trained(run, root)
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in expected)


@needs_chromium
def test_a_training_is_stopped_from_the_browser_and_goes_on_later(root, capture, tmp_path, capsys):
    pytest.importorskip("viser")
    words = ["run", f"scene={capture}", *MIRROR, f"paths.root={tmp_path}"]
    viewed = [*words, "view=true", "viewer.port=0"]
    process, address = started([sys.executable, "-c", WAITING, *viewed], root, tmp_path / "log")
    with chromium.open_tab(address, tmp_path / "profile") as tab:
        press(tab, "Stop after a checkpoint")
        assert process.wait(120) == 130
    assert "rtgs: stopped at step 1; the same command goes on" in (tmp_path / "log").read_text()
    assert main(words) == 0
    assert "resumed from the checkpoint of step 1" in capsys.readouterr().err


def test_a_run_is_shown_with_its_layers_until_its_page_is_closed(run):
    class Closed(FakePage):
        def tell(self, text: str) -> None:
            super().tell(text)
            self.stopped = len(self.seats[0].pictures) > 1

    page = Closed()
    show(open_run(run), page, 0)  # type: ignore[arg-type]
    assert page.kinds == ("final", "diffuse", "reflection", "normal", "depth", "weights")
    assert "step 12" in page.told[-1]
    assert len(page.seats[0].pictures) > 1


def test_the_words_of_a_viewer_are_no_part_of_a_run():
    plain, choices = compose(["scene=demo", "method=2dgs"])
    viewed, same = compose(["scene=demo", "method=2dgs", "view=true", "viewer.port=9000", "viewer.share=0.5"])
    assert (viewed.view, viewed.viewer.port) == (True, 9000)
    assert viewed.name == plain.name
    assert same.overrides == choices.overrides == ()


def test_a_sweep_is_not_viewed(capture, capsys):
    words = ["--multirun", f"scene={capture}", "method=2dgs", *QUICK, "seed=1,2", "view=true"]
    assert main(["run", *words]) == 1
    assert "view=true is for one run" in capsys.readouterr().err


def test_nothing_left_to_train_needs_no_viewer(run, capture, capsys):
    assert main(["run", f"scene={capture}", *MIRROR, "view=true"]) == 0
    assert "nothing is left to train; `rtgs view mirror`" in capsys.readouterr().err


@dataclass(frozen=True)
class NoParams:
    """Of a step that nobody runs."""


@dataclass
class Opened(FakePage):
    address: str = "http://127.0.0.1:0"


def step(name: str) -> Step:
    return Step(name, 1, NoParams(), lambda params, context: None, kind="judge" if name == "judge" else "train_diffuse")


@pytest.mark.parametrize(
    ("name", "remote", "opens"),
    [
        *(("plain", False, True), ("plain_rest", False, True), ("train_diffuse_rest", False, True)),
        *(("train_diffuse", False, True), ("train_diffuse", True, False), ("judge", False, False)),
        *(("member_1", False, True), ("teacher_2", False, True), ("member_1", True, False)),
    ],
)
def test_a_page_is_opened_for_what_trains_here_alone(name, remote, opens, monkeypatch):
    opened = []

    def open_page(settings, label, *, training):
        opened.append(label)
        return nullcontext(Opened())

    monkeypatch.setattr("rtgs.view.page.open_page", open_page)
    config, _ = compose(["scene=demo", "method=2dgs", "name=judged", "view=true"])
    done = PlannedStep(step("train_diffuse"), True, "")
    plan = Plan((done, PlannedStep(step(name), False, "", remote=remote)))
    with viewed(config, plan) as viewer:
        assert (viewer is not None) == opens
    assert opened == ["rtgs: judged"] * opens


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a", "b"], "one run at a time"),
        (["por=1"], "did you mean port="),
        (["port=x"], "port=x must be a whole number from 0 to 65535"),
        (["threads=0"], "threads=0 must be a whole number from 1 to 1024"),
        (["port=1", "port=2"], "port= is given twice"),
        (["--port", "1"], "--port is no word of it: write key=value"),
    ],
)
def test_words_that_are_refused_by_the_viewer(words, message):
    with pytest.raises(RtgsError, match=message):
        parse_words(words)


def test_words_of_the_viewer():
    assert parse_words([]) == ViewWords()
    given = parse_words(["fox", "port=0", "long_side=64", "host=::1"])
    assert (given.run, given.settings.port, given.settings.long_side, given.settings.host) == ("fox", 0, 64, "::1")
