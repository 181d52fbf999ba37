"""The ladder of knowledge about a transparent object: its files, one rung at the smallest size, its pixels."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from lab import glass_ladder
from lab.glass_ladder import (
    BRIGHT,
    COLUMNS,
    Measured,
    base_config,
    bright_pixels,
    figures_of,
    losses,
    named,
    prepare,
    row,
    sized,
)
from lab.glass_rungs import CHOICES, LADDER, RUNGS, Setting
from pipelines.planning.graph import build_graph
from rtgs.config import compose
from rtgs.methods.plans import propagation_due, reflection_plan

TINY = (
    *("scene.long_side=48", "schedule.total=12", "schedule.checkpoint_every=12", "method.density.max_surfels=800"),
    *("method.reflection.cells=3", "method.transmittance.interface.count=100", "method.loss.perceptual=0"),
)


def options(tmp_path: Path) -> SimpleNamespace:
    return SimpleNamespace(preset="smoke", size="preset", set=list(TINY), root=tmp_path)


def test_every_rung_is_another_recipe_of_the_same_scene(tmp_path: Path):
    setting = prepare("ball_statue", options(tmp_path))  # type: ignore[arg-type]
    split = json.loads(setting.split.read_text())
    assert len(split["train"]) == 37
    assert not set(split["train"]) & set(split["test"])
    assert split["test"][:5] == list(setting.held_out)
    assert setting.truth.stat().st_size > 1000
    config = base_config("ball_statue", options(tmp_path))  # type: ignore[arg-type]
    words = {name: tuple(rung.words(setting, config)) for name, rung in RUNGS.items()}
    assert len(set(words.values())) == len(RUNGS)
    assert f"mesh.object.given={setting.truth}" in words["truth"]
    assert "method.loss.mono_normal_masked=2" in words["paper_mono_in_mask"][-1]
    with pytest.raises(SystemExit, match="no path-traced scene"):
        prepare("matte_room", options(tmp_path))  # type: ignore[arg-type]


def test_rungs_share_the_stages_that_do_not_differ(tmp_path: Path):
    arguments = SimpleNamespace(preset="quick", size="small", set=[], root=tmp_path)
    setting = prepare("ball_statue", arguments)  # type: ignore[arg-type]
    config = base_config("ball_statue", arguments)  # type: ignore[arg-type]
    assert (config.schedule.total, config.scene.long_side) == (1000, 128)
    keys: dict[str, dict[str, str]] = {}
    for name in ("truth", "hull", "tsdf", "paper", "before", "normal_hold_1", "paper_mono_in_mask", "two_stages"):
        words = ["scene=ball_statue", "method=rtgs", "preset=quick", *sized(arguments)]  # type: ignore[arg-type]
        words += [f"scene.split_file={setting.split}", *RUNGS[name].words(setting, config)]
        keys[name] = {step.name: step.fingerprint for step in build_graph(*compose(words)).training}
    first, second = ({key[step] for key in keys.values()} for step in ("train_diffuse", "train_reflection"))
    # L_mono of another weight is another first stage; without a third stage mirrors begin later
    assert len(first) == 3
    # "paper": another start of the materials; without a third stage the second goes on to the end
    assert len(second) == 4
    assert len({key["train_transmittance"] for name, key in keys.items() if name != "two_stages"}) == 7


@pytest.mark.parametrize("size", ["small", "preset"])
def test_the_papers_way_has_no_interface_at_any_size(tmp_path: Path, size: str):
    arguments = SimpleNamespace(preset="quick", size=size, set=[], root=tmp_path)
    config = base_config("ball_statue", arguments)  # type: ignore[arg-type]
    setting = Setting("ball_statue", tmp_path / "split.json", tmp_path / "container.ply", ())
    assert config.method.transmittance.interface.count > 0
    words = ["scene=ball_statue", "method=rtgs", "preset=quick", *sized(arguments)]  # type: ignore[arg-type]
    chosen = compose([*words, *RUNGS["paper"].words(setting, config)])[0].method.transmittance
    assert (chosen.interface.count, chosen.split, chosen.first_surface) == (0, False, "base")
    assert all(
        "method.transmittance.interface.count=0" in RUNGS[name].words(setting, config)
        for name in RUNGS
        if name.startswith("paper")
    )


@pytest.mark.parametrize("size", ["small", "preset"])
def test_normal_propagation_has_steps_to_act_in(tmp_path: Path, size: str):
    arguments = SimpleNamespace(preset="quick", size=size, set=[], root=tmp_path)
    config = base_config("ball_statue", arguments)  # type: ignore[arg-type]
    setting = Setting("ball_statue", tmp_path / "split.json", tmp_path / "container.ply", ())
    words = ["scene=ball_statue", "method=rtgs", "preset=quick", *sized(arguments)]  # type: ignore[arg-type]
    chosen = compose([*words, *RUNGS["paper_propagation"].words(setting, config)])[0]
    method = chosen.method.in_scene(glass=True)
    plan, third = (
        reflection_plan(method.reflection, chosen.schedule),
        round(method.transmittance.start * config.schedule.total),
    )
    due = [step for step in range(1, third + 1) if propagation_due(plan, method.reflection, step)]
    assert len(due) >= 2


def test_groups_are_rungs_named_once():
    assert named(["ladder", "choices"]) == [*LADDER, *CHOICES]
    assert named(["hull", "choices", "hull"])[0] == "hull"
    assert len(named(["choices"])) == len(CHOICES) + 2


def test_a_rung_goes_through_the_pipeline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = ["--scenes", "ball_statue", "--rungs", "truth", "--preset", "smoke", "--size", "preset"]
    words += ["--root", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["glass_ladder", *words, "--set", *TINY])
    glass_ladder.main()
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["failures"] == []
    (figures,) = found["figures"]
    assert figures["silhouette_iou"] > 0.9, "the true container fits the masks"
    assert figures["normal_after"] > 0.1
    assert all(figures[name] > 3 for name in ("psnr", "psnr_masked", "psnr_bright", "psnr_held_out"))
    assert figures["seconds"] > 0
    assert figures["seeds"] == [0]
    assert figures["loss"] == {"masked": [0.0], "bright": [0.0]}, "below the first rung, itself"
    text = (tmp_path / "ladder-smoke.md").read_text()
    assert text.startswith(
        "`python -m lab.glass_ladder --preset smoke --size preset --scenes ball_statue --rungs truth --seeds 0"
    )
    assert "| ball_statue | true mesh, true normals held fixed |" in text


def test_losses_are_paired_by_seed_and_have_a_spread():
    def measured(masked: float, bright: float) -> Measured:
        return Measured(20.0, 19.0, 21.0, 0.8, masked, 0.7, bright, None, 0.5, None, 0.5, 0.99, 7.0)

    first = {0: measured(20.0, 15.0), 1: measured(22.0, 16.0), 2: measured(24.0, 17.0)}
    hull = {0: measured(19.5, 13.0), 1: measured(21.4, 14.5), 3: measured(9.0, 9.0)}
    assert losses(hull, first)["masked"] == pytest.approx([0.5, 0.6]), "seeds that both have"
    cells = dict(zip(COLUMNS[-2:], row("ball_statue", "hull", hull, first)[-2:]))
    assert cells == {"loss in the mask": "0.55 +- 0.07", "bright": "1.75 +- 0.35"}
    assert row("ball_statue", "hull", hull, first)[COLUMNS.index("depth before")] == "-"
    assert len(row("ball_statue", "truth", first, first)) == len(COLUMNS)
    assert figures_of("ball_statue", "truth", first, first)["psnr_masked"] == pytest.approx(22.0)


def test_bright_pixels_are_the_brightest_tenth_of_the_mask():
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[5:15, 5:25] = True
    light = torch.rand(3, 20, 30, generator=torch.Generator().manual_seed(0))
    view = SimpleNamespace(mask=mask, truth=SimpleNamespace(reflected=light))
    bright = bright_pixels(view)  # type: ignore[arg-type]
    assert not bool((bright & ~mask).any())
    assert float(bright.sum() / mask.sum()) == pytest.approx(1 - BRIGHT, abs=0.01)
    means = light.mean(0)
    assert float(means[bright].mean()) > float(means[mask].mean()) + 0.1
