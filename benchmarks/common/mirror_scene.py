"""A mirror ball on a table in a painted room, by exact ray casting: a scene whose reflections are known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.scenes.scene import Scene, View

BALL, RADIUS = torch.tensor([0.0, 0.0, -0.2]), 0.6
ROOM = torch.tensor([3.0, 3.0, 1.6])  # half sides; the table is the plane z = TABLE (z down)
TABLE = 0.4


@dataclass(frozen=True)
class MirrorScene:
    scene: Scene
    masks: dict[str, Tensor]  # (H, W) bool by view name: the ball


def wall_color(point: Tensor) -> Tensor:
    """(P, 3) colour of points on the walls and on the table: smooth bands and coarse checks."""
    bands = 0.5 + 0.35 * torch.sin(2.1 * point + torch.tensor([0.0, 1.3, 2.6]))
    checks = ((point[:, :1].floor() + point[:, 1:2].floor() + (1.5 * point[:, 2:]).floor()) % 2) * 0.3
    return (bands * (0.75 + checks)).clamp(0, 1)


def room_hit(origin: Tensor, direction: Tensor) -> Tensor:
    """(P, 3) where rays from inside meet the room or its table."""
    safe = torch.where(direction.abs() < 1e-9, 1e-9, direction)
    low, high = -ROOM.clone(), ROOM.clone()
    high[2] = TABLE
    t = torch.where(safe > 0, (high - origin) / safe, (low - origin) / safe).amin(dim=1)
    return origin + t[:, None] * direction


def ball_hit(origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """(P,) whether unit-direction rays meet the ball, and (P,) where along them."""
    offset = origin - BALL
    along = -(offset * direction).sum(1)
    gap = RADIUS**2 - (offset.square().sum(1) - along.square())
    return (gap > 0) & (along > 0), along - gap.clamp_min(0).sqrt()


def shade(origin: Tensor, direction: Tensor, strength: float) -> tuple[Tensor, Tensor]:
    """(P, 3) colours and (P,) ball mask; the ball is ``strength`` mirror and the rest a warm paint."""
    color = wall_color(room_hit(origin, direction))
    hit, t = ball_hit(origin, direction)
    point = origin + t[:, None] * direction
    normal = (point - BALL) / RADIUS
    mirror = direction - 2 * (direction * normal).sum(1, keepdim=True) * normal
    paint = torch.tensor([0.6, 0.3, 0.2]) * (0.7 + 0.3 * normal[:, 1:2])
    ball = (1 - strength) * paint + strength * wall_color(room_hit(point, mirror))
    return torch.where(hit[:, None], ball, color), hit


def mirror_scene(
    views: int = 20,
    width: int = 64,
    height: int = 48,
    *,
    strength: float = 0.8,
    points: int = 1500,
    test_every: int = 5,
) -> MirrorScene:
    """The scene from a ring of cameras at two heights; ``strength`` 0 is the same room with a matte ball."""
    generator = torch.Generator().manual_seed(11)
    train, test, masks = [], [], {}
    for index in range(views):
        camera = _camera(2 * math.pi * index / views, -0.9 - 0.5 * (index % 2), width, height)
        rays = camera.rays()
        direction = torch.nn.functional.normalize(rays.directions.reshape(-1, 3), dim=1)
        color, mask = shade(rays.origin.expand_as(direction), direction, strength)
        image = color.T.reshape(3, height, width).contiguous()
        name = f"view_{index:02d}"
        view = View(camera, image, None, None, name)
        masks[name] = mask.reshape(height, width)
        (test if index % test_every == 0 else train).append(view)
    position, color = _points(points, generator)
    scene = Scene("mirror_ball", tuple(train), tuple(test), position, color, 2.4, "made")
    return MirrorScene(scene, masks)


def _camera(angle: float, height: float, width: int, rows: int) -> Camera:
    center = torch.tensor([2.2 * math.sin(angle), -2.2 * math.cos(angle), height], dtype=torch.float64)
    forward = torch.nn.functional.normalize(BALL.double() - center, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0, -1]).double()), dim=0)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
    focal = 0.8 * width
    return Camera(rotation, -rotation @ center, focal, focal, width / 2, rows / 2, width, rows)


def _points(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Points on the room, the table and the ball, with the colours of paint (as from structure from motion)."""
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    start = torch.tensor([0.0, 0.0, -0.9]).expand(count, 3)
    walls = room_hit(start, direction)
    on_ball = BALL + RADIUS * direction[: count // 5]
    position = torch.cat((walls, on_ball)) + 0.01 * torch.randn(count + count // 5, 3, generator=generator)
    color = torch.cat((wall_color(walls), torch.full((count // 5, 3), 0.5)))
    return position, color
