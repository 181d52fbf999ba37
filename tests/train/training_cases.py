"""A scene of a few small views and a short recipe, for tests of training.."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch

from rtgs.core.cameras import Camera
from rtgs.gaussians.settings import DensitySettings
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import create_method
from rtgs.methods.settings import MethodSettings
from rtgs.scenes.scene import Scene, View
from rtgs.train.seeds import generator_for
from rtgs.train.settings import LossSettings, ScheduleSettings
from rtgs.train.trainer import Trainer

WIDTH, HEIGHT = 40, 30


def look_at_origin(angle: float, radius: float = 4.0, height: float = -0.8) -> Camera:
    """A camera on a circle around the origin."""
    center = torch.tensor([radius * math.sin(angle), height, -radius * math.cos(angle)], dtype=torch.float64)
    forward = -center / center.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), forward)
    right = right / right.norm()
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
    focal = 1.1 * WIDTH
    return Camera(rotation, -rotation @ center, focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def pattern(camera: Camera) -> torch.Tensor:
    """(3, H, W) colours of a coloured sphere before a grey sky, by ray casting: the same object in every view."""
    rays = camera.rays(torch.float64)
    direction = rays.directions / rays.directions.norm(dim=-1, keepdim=True)
    along = -(direction * rays.origin).sum(-1)
    gap = 1 - (rays.origin.square().sum() - along.square())
    hit = rays.origin + (along - gap.clamp_min(0).sqrt())[..., None] * direction
    color = torch.where(gap[..., None] > 0, 0.5 + 0.4 * torch.sin(3 * hit), torch.tensor(0.3, dtype=torch.float64))
    return color.permute(2, 0, 1).float().contiguous()


def small_scene(views: int = 6, *, noise: bool = False, normals: bool = False, points: int = 300) -> Scene:
    """A coloured unit sphere seen from ``views`` cameras (or noise images), with points on it; the last is for test."""
    generator = torch.Generator().manual_seed(7)
    found = []
    for index in range(views):
        camera = look_at_origin(2 * math.pi * index / views)
        image = torch.rand(3, HEIGHT, WIDTH, generator=generator) if noise else pattern(camera)
        normal = torch.tensor([0.0, 0.0, -1.0]).reshape(3, 1, 1).expand(3, HEIGHT, WIDTH).contiguous()
        found.append(View(camera, image, None, normal if normals else None, f"view_{index}"))
    position = torch.nn.functional.normalize(torch.randn(points, 3, generator=generator), dim=1)
    return Scene(
        "small", tuple(found[:-1]), tuple(found[-1:]), position, 0.5 + 0.4 * torch.sin(3 * position), 4.4, "made"
    )


def named(scene: Scene) -> Scene:
    """The scene, its cameras with the names of their views, as importers give them."""

    def of(views: tuple[View, ...]) -> tuple[View, ...]:
        return tuple(replace(view, camera=replace(view.camera, name=view.name)) for view in views)

    return replace(scene, train=of(scene.train), test=of(scene.test), held=of(scene.held))


def small_schedule(total: int = 60, **changes: int) -> ScheduleSettings:
    values = dict(
        total=total, sh_every=20, densify_from=5, densify_until=45, densify_every=20, opacity_reset_every=40,
        means_lr_steps=total, checkpoint_every=15,
    )  # fmt: skip
    return ScheduleSettings(**(values | changes))


def small_method(name: str = "2dgs") -> MethodSettings:
    plain = name.startswith("3dgs") or name == "gaussian_shader"
    light = EnvironmentSettings()
    if name == "gaussian_shader":
        light = EnvironmentSettings(side=16, mips="ggx", levels=(16, 8, 8), activation="identity", initial=0.8, noise=0)
    if name == "ref_gs":
        light = EnvironmentSettings(side=16, noise=0.0, rate=0.002)
    return MethodSettings(
        name=name,
        loss=LossSettings(normal=0.0) if plain else LossSettings(normal_start=0.25, mono_normal=0.01),
        environment=light,
        density=DensitySettings(gradient_threshold=5e-5, max_surfels=1200),
    )


def small_trainer(
    scene: Scene | None = None,
    settings: MethodSettings | None = None,
    schedule: ScheduleSettings | None = None,
    *,
    checkpoint_dir: Path | None = None,
    seed: int = 3,
    **listeners,
) -> Trainer:
    """A trainer on :func:`small_scene`; ``listeners`` are the trainer's progress and recorder."""
    scene = scene or small_scene()
    method = create_method(
        settings or small_method(), scene, schedule or small_schedule(), generator_for(seed, "initialise")
    )
    return Trainer(method, scene, seed=seed, checkpoint_dir=checkpoint_dir, **listeners)
