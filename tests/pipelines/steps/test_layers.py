"""Layers on their way from a rendered view to the evaluation and the page."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from pipelines.steps import render, report
from rtgs.core.errors import RtgsError
from rtgs.runs import views


def rendered_view(folder: Path, layers: bool) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    tensors = {"image": torch.rand(3, 4, 5, generator=generator), "normal": torch.rand(3, 4, 5, generator=generator)}
    if layers:
        tensors |= {name: torch.rand(3, 4, 5, generator=generator) for name in ("diffuse", "reflection")}
        tensors |= {name: torch.rand(4, 5, generator=generator) for name in ("specular", "roughness", "f0")}
    (folder / "views").mkdir(parents=True)
    save_file(tensors, folder / "views" / "a.safetensors")
    (folder / render.TIMES_FILE).write_text('{"seconds": {"a.png": 0.5}}')
    return tensors


def test_the_page_gets_the_diffuse_part_and_the_evaluation_the_reflection(tmp_path: Path) -> None:
    tensors = rendered_view(tmp_path, layers=True)
    layers = report._layers(views.read_render(tmp_path, "a.png"))
    assert set(layers) == {"diffuse", "reflection", "normal", "specular", "roughness", "f0"}
    torch.testing.assert_close(layers["diffuse"], (1 - tensors["specular"]) * tensors["diffuse"])
    timed = render.read_timed(tmp_path, render.RenderTimes.read(tmp_path), "a.png")
    assert timed.reflection is not None
    assert torch.equal(timed.reflection, tensors["reflection"])
    assert timed.seconds == 0.5


def test_methods_without_reflection_have_none(tmp_path: Path) -> None:
    rendered_view(tmp_path, layers=False)
    assert report._layers(views.read_render(tmp_path, "a.png")) == {}
    times = render.RenderTimes.read(tmp_path)
    assert render.read_timed(tmp_path, times, "a.png").reflection is None
    assert not times.with_maps  # artifacts of older versions timed the image alone
    with pytest.raises(RtgsError, match=r"view 'b.png' was not rendered: render.json has a.png"):
        times.of("b.png")
