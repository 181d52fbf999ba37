"""A glass ball around a painted core, in the room of the mirror ball; its mesh; short recipes with three stages."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from reflective_cases import recipe, schedule
from torch import Tensor

from benchmarks.common.mirror_scene import BALL, RADIUS, ball_hit, mirror_scene, room_hit, wall_color
from rtgs.gaussians.settings import DensitySettings, InitSettings
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.triangles import TriangleMesh
from rtgs.methods import create_method
from rtgs.methods.model import Model
from rtgs.methods.settings import InterfaceSettings, MethodSettings, TransmittanceSettings
from rtgs.optics.settings import WallSettings
from rtgs.scenes.scene import Scene, View
from rtgs.train.seeds import generator_for
from rtgs.train.settings import ScheduleSettings
from rtgs.train.trainer import Trainer

CORE = 0.3  # radius of what is inside
INTERFACE = InterfaceSettings(count=150, normal_loss=0.2, normal_hold=0.0)  # the loss that depends on the picture
REFLECTED = 0.25  # share of light that the glass reflects


@dataclass(frozen=True)
class GlassScene:
    scene: Scene
    mesh: ObjectMesh


def glass_scene(
    views: int = 8, width: int = 24, height: int = 18, *, points: int = 250, test_every: int = 8, masked: bool = True
) -> GlassScene:
    """The room with a ball that reflects a share of the light and lets the rest through, to a core or to the wall."""
    made = mirror_scene(views, width, height, points=points, test_every=test_every)

    def through(view: View) -> View:
        camera = view.camera
        direction = torch.nn.functional.normalize(camera.rays().directions.reshape(-1, 3), dim=1)
        origin = camera.center.float().expand_as(direction)
        hit, distance = ball_hit(origin, direction)
        point = origin + distance[:, None] * direction
        normal = (point - BALL) / RADIUS
        mirror = direction - 2 * (direction * normal).sum(1, keepdim=True) * normal
        reflected = wall_color(room_hit(point, mirror))
        behind = wall_color(room_hit(origin, direction))
        offset = origin - BALL
        along = -(offset * direction).sum(1)
        core = offset.square().sum(1) - along.square() < CORE**2
        inner = torch.where(core[:, None], torch.tensor([0.7, 0.2, 0.1]), behind)
        glass = REFLECTED * reflected + (1 - REFLECTED) * inner
        image = torch.where(hit[:, None], glass, behind).T.reshape(3, camera.height, camera.width)
        mask = hit.reshape(camera.height, camera.width)
        return replace(view, image=image.contiguous(), mask=mask if masked else None)

    train, test = (tuple(through(view) for view in part) for part in (made.scene.train, made.scene.test))
    inner_points = BALL + CORE * torch.nn.functional.normalize(
        torch.randn(60, 3, generator=torch.Generator().manual_seed(2)), dim=1
    )
    colors = torch.tensor([0.7, 0.2, 0.1]).expand(60, 3)
    scene = replace(
        made.scene,
        name="glass_ball",
        train=train,
        test=test,
        points=torch.cat((made.scene.points, inner_points)),
        point_colors=torch.cat((made.scene.point_colors, colors)),
    )
    return GlassScene(scene, ball_mesh())


def ball_mesh(rings: int = 12, segments: int = 24, *, flat: bool = False) -> ObjectMesh:
    """The ball as triangles, outward oriented; ``flat``: declared a pane, for what a pane does."""
    theta = np.linspace(0, np.pi, rings + 1)
    phi = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    ring = [[np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)] for t in theta[1:-1] for p in phi]
    vertices = np.array([[0, 0, 1.0], *ring, [0, 0, -1.0]])
    last = len(vertices) - 1
    faces = [[0, 1 + k, 1 + (k + 1) % segments] for k in range(segments)]
    for row in range(rings - 2):
        a, b = 1 + row * segments, 1 + (row + 1) * segments
        for k in range(segments):
            n = (k + 1) % segments
            faces += [[a + k, b + k, b + n], [a + k, b + n, a + n]]
    a = 1 + (rings - 2) * segments
    faces += [[last, a + (k + 1) % segments, a + k] for k in range(segments)]
    mesh = TriangleMesh(BALL.numpy() + RADIUS * vertices, np.array(faces))
    return ObjectMesh(mesh, "given", voxel=0.02, flat=flat)


def glass_recipe(**changes) -> MethodSettings:
    """Every mechanism of the third stage within 60 steps."""
    default = TransmittanceSettings(
        start=0.5,
        cells=3,
        per_cell=4,
        densify_from=2,
        densify_until=0.9,
        densify_every=8,
        opacity_reset_every=20,
        sh_every=10,
        rim=0,  # of a 24x18 picture 2 pixels are much
        keep_seen=0,
        max_gain=None,
        interface=INTERFACE,
        density=DensitySettings(gradient_threshold=1e-6, max_surfels=600, min_opacity=0.005),
        init=InitSettings(scale=0.5),
    )
    base = recipe("rtgs")
    loss = replace(base.loss, specular=0.2, specular_start=0.5, transmission_depth=0.2, transmission_depth_start=0.75)
    return replace(base, loss=loss, transmittance=replace(default, **changes))


def fresnel(**changes: object) -> MethodSettings:
    base = glass_recipe(normal="mesh")
    return replace(
        base,
        optics=replace(base.optics, blend="linear"),
        loss=replace(base.loss, clipped=True),
        transmittance=replace(base.transmittance, wall=WallSettings(light="fresnel", **changes)),  # type: ignore[arg-type]
    )


def new_glass_method(
    settings: MethodSettings,
    made: GlassScene,
    plan: ScheduleSettings | None = None,
    *,
    mesh: bool = True,
    seed: int = 3,
) -> Model:
    generator = generator_for(seed, "initialise")
    method = create_method(settings, made.scene, plan or schedule(), generator, made.mesh if mesh else None)
    assert isinstance(method, Model)
    return method


def train_stages(method: Model, scene: Scene, *, seed: int = 3, folder: Path | None = None) -> None:
    """All stages of a method in one process."""
    before = None
    for stage in method.stages:
        trainer = Trainer(method, scene, seed=seed, stage=stage, checkpoint_dir=folder)
        if before is not None:
            trainer._order = before._order
        trainer.run()
        before = trainer


def begun(settings: MethodSettings, made: GlassScene, plan: ScheduleSettings | None = None) -> Model:
    """A method whose stages have all begun, untrained."""
    method = new_glass_method(settings, made, plan)
    for stage in method.stages:
        method.begin(stage)
    return method


def randomised(method: Model, seed: int = 4) -> Tensor | None:
    """Colours that depend on direction and opaque sets, so that every parameter has a gradient."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for part in method.sets:
            part.gaussians.sh_rest += 0.1 * torch.randn(part.gaussians.sh_rest.shape, generator=generator)
            part.gaussians.opacity_logits += 1.0
        method["base"].gaussians.log_scales += 0.3
    return None


def held(weight: float, rate: float = 0.0) -> MethodSettings:
    """Normals held by ``weight``, and nothing else that holds them."""
    return glass_recipe(interface=replace(INTERFACE, normal_loss=rate, normal_hold=weight))
