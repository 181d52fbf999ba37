"""What nerfbaselines asks of a method (its class ``Method``), answered by a model of rtgs.

Frames agree: poses are camera to world, x right, y down, z forward; pixels' centres lie at one half. Masks of glass are
not part of its datasets, so the glass stage of method ``rtgs`` has nothing to work on and is not offered.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

import rtgs
from rtgs.config import compose
from rtgs.core.documents import load_json
from rtgs.scenes.canonical import read_scene, save_scene
from rtgs.scenes.points import camera_extent
from rtgs.train.losses import surface_depth
from rtgs.train.resolution import GrowingViews
from rtgs.train.seeds import seed_for
from rtgs.train.view_order import OrderState, ViewOrder

_SETTINGS, _STATE, _SCENE = "rtgs.json", "state.safetensors", "scene"


class RtgsMethod:
    """One of rtgs's methods; ``config_overrides`` are words of ``rtgs run``: ``preset``, ``seed``, any key."""

    METHOD = ""

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: dict[str, Any] | None = None,
        config_overrides: dict[str, Any] | None = None,
    ) -> None:
        if checkpoint is None and train_dataset is None:
            raise rtgs.RtgsError(f"{self.method_id()}: neither a checkpoint nor a dataset to train on was given")
        self._checkpoint = None if checkpoint is None else Path(checkpoint)
        found: dict[str, Any] = {} if self._checkpoint is None else load_json(self._checkpoint / _SETTINGS)
        words = {"preset": "quick"} | found.get("words", {}) | (config_overrides or {})
        self._words = {key: str(value) for key, value in words.items()}
        config, _ = compose(["scene=demo", f"method={self.METHOD}", *(f"{k}={v}" for k, v in self._words.items())])
        if self._checkpoint is not None:
            self._scene = read_scene(self._checkpoint / _SCENE)
        else:
            assert train_dataset is not None
            self._scene = scene_of(train_dataset)
        generator = rtgs.generator_for(config.seed, "initialise")
        self.model = rtgs.create_method(config.method, self._scene, config.schedule, generator)
        self._order = ViewOrder(len(self._scene.train), seed_for(config.seed, "views"))
        self._growing = GrowingViews(self._scene.train, config.schedule)
        self._step = int(found.get("step", 0))
        self._loaded = self._step if self._checkpoint is not None else None
        if self._checkpoint is not None:
            self._load(self._checkpoint)

    @classmethod
    def method_id(cls) -> str:
        """Of the registered spec."""
        return f"rtgs-{cls.METHOD.replace('_', '-')}"

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """What datasets must have, and what is rendered."""
        return {
            "method_id": cls.method_id(),
            "required_features": frozenset(("color", "points3D_xyz", "points3D_rgb")),
            "supported_camera_models": frozenset(("pinhole",)),
            "supported_outputs": ("color", "depth", "accumulation"),
            "can_resume_training": True,
        }

    def get_info(self) -> dict[str, Any]:
        """The same, and how far this model is."""
        return self.get_method_info() | {
            "num_iterations": self.model.stages[-1].until,
            "loaded_step": self._loaded,
            "loaded_checkpoint": None if self._checkpoint is None else str(self._checkpoint),
            "batch_size": 1,
            "eval_batch_size": 1,
            "hparams": {"method": self.METHOD} | self._words,
        }

    def get_train_embedding(self, index: int) -> None:
        """There is none: photos have no codes of their own."""

    def optimize_embedding(self, dataset: object, *, embedding: object = None) -> dict[str, Any]:
        """Raises: NotImplementedError: there are no embeddings."""
        raise NotImplementedError(f"{self.method_id()} has no embeddings")

    def train_iteration(self, step: int) -> dict[str, float]:
        """One step on one view, as :class:`rtgs.Trainer` does it; steps must come in order."""
        if step != self._step:
            raise rtgs.RtgsError(f"{self.method_id()}: step {step} was asked for, {self._step} is next")
        for stage in self.model.stages:
            if step == stage.from_step:
                self.model.begin(stage)
        view = self._growing.at(self._order.next(), step)
        rendered = self.model.render(view.camera, step, rtgs.Mode.TRAIN, mask=view.mask)
        losses = self.model.losses(rendered, view, step)
        losses.total.backward()
        self.model.after_step(step, rendered.observations)
        self._step = step + 1
        with torch.no_grad():
            psnr = float(rtgs.psnr(rendered.image.detach(), view.image))
        return {
            "loss": float(losses.total.detach()),
            "psnr": psnr,
            "num_gaussians": float(sum(map(len, self.model.sets))),
        }

    def render(self, camera: Any, *, options: dict[str, Any] | None = None) -> dict[str, np.ndarray]:
        """Colour (h, w, 3) in 0 to 1, depth (h, w) along z, accumulation (h, w); all of them, whatever is asked for."""
        with torch.no_grad():
            wanted = rtgs.RenderOptions(depth=True)
            seen = self.model.render(camera_of(camera.item()), self._step, rtgs.Mode.EVALUATE, wanted)
        buffers = seen.buffers
        assert buffers.depth is not None
        return {
            "color": seen.image.clamp(0, 1).permute(1, 2, 0).contiguous().numpy(),
            "depth": surface_depth(buffers.depth, buffers.alpha).numpy(),
            "accumulation": buffers.alpha.numpy(),
        }

    def save(self, path: str) -> None:
        """Everything that goes on from here needs: settings, the scene, the state."""
        from safetensors.torch import save_file

        folder = Path(path)
        (folder / _SCENE).mkdir(parents=True, exist_ok=True)
        save_scene(self._scene, folder / _SCENE)
        order = self._order.state()
        state = {f"method.{name}": tensor.detach().contiguous() for name, tensor in self.model.state().items()}
        state |= {"views.permutation": order.permutation, "views.generator": order.generator}
        save_file(state, folder / _STATE)
        about = {"method": self.METHOD, "words": self._words, "step": self._step, "position": order.position}
        (folder / _SETTINGS).write_text(json.dumps(about), encoding="utf-8")

    def _load(self, folder: Path) -> None:
        from safetensors.torch import load_file

        about, state = load_json(folder / _SETTINGS), load_file(folder / _STATE)
        if about["method"] != self.METHOD:
            raise rtgs.RtgsError(f"{folder} is a checkpoint of method {about['method']}, not of {self.METHOD}")
        self.model.load({name.removeprefix("method."): t for name, t in state.items() if name.startswith("method.")})
        self._order.load(OrderState(state["views.permutation"], about["position"], state["views.generator"]))


def scene_of(dataset: dict[str, Any]) -> rtgs.Scene:
    """A dataset of nerfbaselines with its pictures as a scene; all of its views are for training.

    Raises:
        RtgsError: it has no points, or cameras that are no pinholes.
    """
    cameras, root = dataset["cameras"], dataset["image_paths_root"]
    if dataset["points3D_xyz"] is None or dataset["points3D_rgb"] is None:
        raise rtgs.RtgsError("the dataset has no points (points3D_xyz, points3D_rgb) to begin with")
    views = []
    for index, path in enumerate(dataset["image_paths"]):
        name = Path(path).relative_to(root).as_posix() if Path(path).is_relative_to(root) else Path(path).name
        camera = camera_of(cameras[index], name)
        pixels = torch.from_numpy(np.asarray(dataset["images"][index])[: camera.height, : camera.width].copy())
        image = pixels.float() / 255 if pixels.dtype == torch.uint8 else pixels.float()
        if image.shape[-1] == 4:  # over black, as its evaluation has it
            image = image[..., :3] * image[..., 3:]
        views.append(rtgs.View(camera, image.permute(2, 0, 1).contiguous(), None, None, name))
    extent = camera_extent(np.stack([view.camera.center.numpy() for view in views]))
    points = torch.from_numpy(np.asarray(dataset["points3D_xyz"], dtype=np.float32))
    colors = torch.from_numpy(np.asarray(dataset["points3D_rgb"], dtype=np.float32) / 255)
    return rtgs.Scene("nerfbaselines", tuple(views), (), points, colors, extent, "a dataset of nerfbaselines")


def camera_of(camera: Any, name: str = "") -> rtgs.Camera:
    """One camera of nerfbaselines.

    Raises:
        RtgsError: it is no pinhole.
    """
    if int(camera.camera_models) != 0:
        raise rtgs.RtgsError(f"camera {name!r} is no pinhole: let nerfbaselines undistort the dataset")
    pose = torch.from_numpy(np.asarray(camera.poses, dtype=np.float64))
    rotation = pose[:3, :3].T
    fx, fy, cx, cy = (float(value) for value in camera.intrinsics)
    width, height = (int(value) for value in camera.image_sizes)
    return rtgs.Camera(rotation, -rotation @ pose[:3, 3], fx, fy, cx, cy, width, height, name)


class Surfels(RtgsMethod):
    METHOD = "2dgs"


class Ellipsoids(RtgsMethod):
    METHOD = "3dgs"


class DeferredReflection(RtgsMethod):
    METHOD = "3dgs_dr"


class EnvironmentGaussians(RtgsMethod):
    METHOD = "envgs"
