"""The methods as nerfbaselines calls them: train, render, save, load, go on; with its own types where it is there."""

from __future__ import annotations

import importlib.util
import inspect
import sys
import types
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

import rtgs

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "nerfbaselines_method"
WORDS = {"preset": "smoke", "schedule.total": 6, "method.reflection.start": 0.3, "method.reflection.matte.probation": 0}


@dataclass
class Cameras:
    """The part of nerfbaselines' cameras that is read: arrays of N, or of one."""

    poses: np.ndarray
    intrinsics: np.ndarray
    camera_models: np.ndarray
    image_sizes: np.ndarray

    def __getitem__(self, index: int) -> Cameras:
        return Cameras(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def item(self) -> Cameras:
        return self if self.poses.ndim == 2 else self[0]


@pytest.fixture(scope="module")
def module() -> Iterator[types.ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        import rtgs_method  # pyright: ignore[reportMissingImports]

        yield rtgs_method
        sys.modules.pop("rtgs_method", None)


@pytest.fixture(scope="module")
def scene() -> rtgs.Scene:
    return rtgs.load_scene(rtgs.SceneSettings(path="embedded:spheres", long_side=48, max_views=8))


def dataset_of(scene: rtgs.Scene) -> dict:
    def pose(camera: rtgs.Camera) -> np.ndarray:
        return torch.cat([camera.rotation.T, camera.center[:, None]], dim=1).numpy()

    seen = [view.camera for view in scene.train]
    cameras = Cameras(
        np.stack([pose(each) for each in seen]),
        np.array([[each.fx, each.fy, each.cx, each.cy] for each in seen]),
        np.zeros(len(seen), np.int32),
        np.array([[each.width, each.height] for each in seen]),
    )
    images = [rtgs.to_bytes(view.image) for view in scene.train]
    paths = [f"/data/images/{view.name}" for view in scene.train]
    colors = (scene.point_colors * 255).byte().numpy()
    return {
        "cameras": cameras,
        "images": images,
        "image_paths": paths,
        "image_paths_root": "/data/images",
        "points3D_xyz": scene.points.numpy(),
        "points3D_rgb": colors,
    }


def trained(module, dataset: dict, words: dict, until: int):
    method = module.EnvironmentGaussians(train_dataset=dataset, config_overrides=words)
    for step in range(until):
        found = method.train_iteration(step)
        assert np.isfinite(found["loss"])
    return method


def test_cameras_and_pictures_arrive_as_they_are(module, scene):
    found = module.scene_of(dataset_of(scene))
    assert [view.name for view in found.train] == [view.name for view in scene.train]
    for mine, theirs in zip(found.train, scene.train, strict=True):
        point = torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64)
        assert torch.allclose(mine.camera.project(point)[0], theirs.camera.project(point)[0])
        assert (mine.image - theirs.image.clamp(0, 1)).abs().max() <= 0.5 / 255 + 1e-6
    assert found.extent == pytest.approx(scene.extent, rel=1e-6)


def test_a_training_that_is_saved_goes_on_to_the_same_bits(module, scene, tmp_path):
    dataset = dataset_of(scene)
    whole = trained(module, dataset, WORDS, 6)
    half = trained(module, dataset, WORDS, 3)
    half.save(str(tmp_path / "half"))
    again = module.EnvironmentGaussians(checkpoint=str(tmp_path / "half"), train_dataset=dataset)
    assert again.get_info()["loaded_step"] == 3
    assert again.get_info()["num_iterations"] == 6
    for step in range(3, 6):
        again.train_iteration(step)
    camera = dataset["cameras"][0]
    first, second = whole.render(camera), again.render(camera)
    height, width = dataset["images"][0].shape[:2]
    assert first["color"].shape == (height, width, 3)
    assert first["depth"].shape == first["accumulation"].shape == (height, width)
    assert first["color"].dtype == np.float32
    assert 0 <= first["color"].min() <= first["color"].max() <= 1
    for name in first:
        assert (first[name] == second[name]).all(), name
    again.save(str(tmp_path / "end"))
    shown = module.EnvironmentGaussians(checkpoint=str(tmp_path / "end"))
    assert (shown.render(camera)["color"] == first["color"]).all()
    with pytest.raises(rtgs.RtgsError, match="checkpoint of method envgs, not of 2dgs"):
        module.Surfels(checkpoint=str(tmp_path / "end"))


def test_what_does_not_fit_is_told(module, scene):
    dataset = dataset_of(scene)
    with pytest.raises(rtgs.RtgsError, match="neither a checkpoint nor a dataset"):
        module.Surfels()
    with pytest.raises(rtgs.RtgsError, match="no points"):
        module.Surfels(train_dataset=dataset | {"points3D_xyz": None})
    bent = Cameras(**(vars(dataset["cameras"]) | {"camera_models": np.ones(len(dataset["images"]), np.int32)}))
    with pytest.raises(rtgs.RtgsError, match="is no pinhole"):
        module.Surfels(train_dataset=dataset | {"cameras": bent})
    method = module.Surfels(train_dataset=dataset, config_overrides=WORDS)
    with pytest.raises(rtgs.RtgsError, match="step 4 was asked for, 0 is next"):
        method.train_iteration(4)


def test_specs_are_registered_one_for_each_method(module, monkeypatch):
    found: list[dict] = []
    if importlib.util.find_spec("nerfbaselines") is None:
        stub = types.ModuleType("nerfbaselines")
        stub.register = found.append  # pyright: ignore[reportAttributeAccessIssue]
        monkeypatch.setitem(sys.modules, "nerfbaselines", stub)
        _run_spec()
    else:
        from nerfbaselines._registry import collect_register_calls  # pyright: ignore[reportMissingImports]

        with collect_register_calls(found):
            _run_spec()
    assert [each["id"] for each in found] == ["rtgs-2dgs", "rtgs-3dgs", "rtgs-3dgs-dr", "rtgs-envgs"]
    for each in found:
        name, _, kind = each["method_class"].partition(":")
        assert getattr(sys.modules[name], kind).method_id() == each["id"]


def _run_spec() -> None:
    spec = importlib.util.spec_from_file_location("rtgs_spec", FOLDER / "rtgs_spec.py")
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))


def test_the_methods_have_what_the_protocol_asks_for(module):
    types_of = pytest.importorskip("nerfbaselines")
    for name, asked in inspect.getmembers(types_of.Method, inspect.isfunction):
        if name.startswith("_") and name != "__init__":
            continue
        given = inspect.signature(getattr(module.RtgsMethod, name)).parameters
        assert set(inspect.signature(asked).parameters) <= set(given), name
