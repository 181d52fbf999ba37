"""The tool that compares the normals of a mesh before and after its vertices were learned: from the true ball on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks.quality import learned_normals
from rtgs.core.errors import RtgsError
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.score import container_mesh
from rtgs.methods import create_method
from rtgs.methods.model import Model
from rtgs.methods.parts.glass import Glass
from rtgs.methods.settings import MethodSettings, TransmittanceSettings, VertexSettings
from rtgs.scenes.scene import Scene, load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.train.seeds import generator_for
from rtgs.train.settings import ScheduleSettings


def method_of(scene: Scene, rate: float) -> Model:
    """A third stage that has just begun, on the true mesh."""
    truth = container_mesh(scene.name)
    assert truth is not None
    transmittance = TransmittanceSettings(normal="mesh", opaque_share=1.0, vertices=VertexSettings(rate=rate))
    settings = MethodSettings(name="rtgs", transmittance=transmittance)
    mesh = ObjectMesh(truth, "given", 0.02, flat=False)
    method = create_method(settings, scene, ScheduleSettings(total=60), generator_for(0, "initialise"), mesh)
    assert isinstance(method, Model)
    for stage in method.stages:
        method.begin(stage)
    return method


def test_both_meshes_are_scored(run, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(SceneSettings(name="ball_statue", path="embedded:ball_statue", long_side=32, max_views=16))
    method = method_of(scene, 0.03)
    glass = method.parts["glass"]
    assert isinstance(glass, Glass)
    assert glass.vertices is not None
    heights = glass.vertices.group["heights"]
    with torch.no_grad():
        heights.add_(torch.randn(len(heights), generator=torch.Generator().manual_seed(0)))
    assert any(event.kind == "mesh" for event in glass.control(60))
    asked: list[str] = []
    monkeypatch.setattr(learned_normals, "artifact", lambda folder, step: asked.append(step) or folder)
    monkeypatch.setattr(learned_normals, "read_scene", lambda folder: scene)
    monkeypatch.setattr(learned_normals, "load_method", lambda folder, scene: (method, None))
    found, learned = run(learned_normals, "runs/ball")["rows"]
    assert set(asked) == {"import_scene", "train_transmittance"}
    assert (found["mesh"], learned["mesh"], found["run"]) == ("found", "learned", "ball")
    assert found["normals"]["front"] < 0.2
    assert learned["normals"]["front"] > 1.0
    assert learned["normals"]["back"] > 1.0
    assert "median" in learned["moved"]
    assert not found["moved"]
    monkeypatch.setattr(learned_normals, "load_method", lambda folder, scene: (method_of(scene, 0.0), None))
    with pytest.raises(RtgsError, match=r"learned no vertices: run with method\.transmittance\.vertices\.rate"):
        learned_normals.measure(Path("runs/ball"))
    monkeypatch.setattr(learned_normals, "read_scene", lambda folder: replace(scene, name="somewhere"))
    with pytest.raises(RtgsError, match="somewhere, which has no true container"):
        learned_normals.measure(Path("runs/ball"))
