"""One set of Gaussians with spherical harmonics that looks as a model of several layers does.

Viewers of Gaussian splats know one set and no rays. So the layered model is rendered from the cameras of its training
and from cameras between them, and one set is fitted to these pictures. It starts from the model's own sets that stand
where they are seen; what a mirror shows it can only say in spherical harmonics of degree 3, and that is what is lost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from rtgs.core.cameras import Camera
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.primitives import PARAMETERS, Gaussians
from rtgs.gaussians.settings import DensitySettings, InitSettings, OptimizerSettings
from rtgs.gaussians.surfels import Surfels
from rtgs.methods.model import Model
from rtgs.methods.parts.base import BaseSet
from rtgs.methods.parts.gaussian_set import GaussianSet
from rtgs.methods.parts.kinds import ELLIPSOIDS, SURFELS
from rtgs.methods.settings import MethodSettings
from rtgs.methods.spec import MethodSpec, Setup, StageSpec
from rtgs.render.paths import cameras_path, picture_of, several_places
from rtgs.render.settings import RenderSettings
from rtgs.scenes.scene import Scene, View
from rtgs.train.method import Stage
from rtgs.train.progress import Progress
from rtgs.train.seeds import generator_for
from rtgs.train.settings import LossSettings, ScheduleSettings
from rtgs.train.trainer import Trainer

BAKE_VERSION = 1  # of what a fit gives: count it up when that changes
SH_DEGREE = 3  # the most that viewers know
MOST_BETWEEN = 100  # cameras between those of the training
HELD_EVERY = 8  # of the cameras between, where a scene has no test views
SEED = 0
GROWTH = 1.5  # times the Gaussians in the beginning
_REST = (SH_DEGREE + 1) ** 2 - 1

Picture = tuple[Camera, Tensor]


@dataclass(frozen=True)
class BakeSettings:
    """How one set is fitted.

    Attributes:
        steps: of the fit.
        most: Gaussians in the result; None: 1.5 times those in the beginning.
    """

    steps: int = 2000
    most: int | None = None


@dataclass(frozen=True)
class Baked:
    """One set, and how well it stands for the layered model.

    Attributes:
        views: pictures of the layered model that it was fitted to.
        psnr: dB against the layered model, mean over cameras that it was not fitted to.
    """

    gaussians: Gaussians
    views: int
    psnr: float


@dataclass(frozen=True)
class Chosen:
    """Cameras of a scene: those that one set is fitted from, and those that it is measured from."""

    fitted: tuple[Camera, ...]
    held: tuple[Camera, ...]


def choose_cameras(scene: Scene) -> Chosen:
    """The training cameras and as many between them to fit from, the test cameras to measure from.

    Without test views every eighth camera between the others is held out.
    """
    cameras = [view.camera for view in scene.train]
    between: list[Camera] = []
    if several_places(cameras):
        between = cameras_path(cameras, picture_of(cameras), min(len(cameras), MOST_BETWEEN))
    if scene.test:
        return Chosen((*cameras, *between), tuple(view.camera for view in scene.test))
    kept = [camera for index, camera in enumerate(between) if index % HELD_EVERY]
    return Chosen((*cameras, *kept), tuple(between[::HELD_EVERY] or cameras[:1]))


def bake(
    scene: Scene,
    fitted: Sequence[Picture],
    held: Sequence[Picture],
    begin: Gaussians,
    render: RenderSettings,
    settings: BakeSettings,
    progress: Progress | None = None,
) -> Baked:
    """Fit one set to pictures of a layered model.

    Parameters
    ----------
    scene : Scene
        Of the model: its extent counts.
    fitted, held : sequence of (Camera, (3, H, W) Tensor)
        The layered model in [0, 1] from the cameras of :func:`choose_cameras`.
    begin : Surfels or Ellipsoids
        Where the fit begins; the result is of the same kind. They stay as they are.
    render : RenderSettings
        Of the model: its near, far and background. Filters are those of common viewers.
    settings : BakeSettings
        How long, and how many.
    progress : Progress, optional
        Who is told how far it is.

    Returns
    -------
    Baked
        Of SH degree 3, without channels.

    Raises
    ------
    TrainingDiverged
        A loss or gradient is not finite.
    RtgsError
        Density control left no Gaussian.
    """
    rows = joined([begin])
    most = settings.most or max(len(rows), math.ceil(GROWTH * len(rows)))
    rows = largest(rows, most)
    steps = settings.steps
    method = MethodSettings(
        name=_SPEC.name,
        loss=LossSettings(normal=0.0, distortion=0.0),
        optimizer=OptimizerSettings(sh_dc=0.01, sh_rest=0.001, log_scales=0.01, decay_from=0.5),  # as preset=quick
        init=InitSettings(min_points=1),
        density=DensitySettings(max_surfels=most, cap_turnover=0.05, min_opacity=0.005),
        render=RenderSettings(near=render.near, far=render.far, background=render.background),
    )
    schedule = ScheduleSettings(
        total=steps,
        sh_every=1,
        densify_from=0,
        densify_until=round(0.7 * steps),
        opacity_reset_every=0,
        means_lr_steps=steps,
    )
    colors = torch.zeros_like(rows.means)
    shown = replace(
        scene,
        train=tuple(_view(*each) for each in fitted),
        test=tuple(_view(*each) for each in held),
        held=(),
        points=rows.means.clone(),
        point_colors=colors,
    )
    setup = Setup(_SPEC, method, shown, schedule, generator_for(SEED, "bake"), stages=(Stage(_STAGE, 0, steps),))
    model = _model(setup, rows)
    summary = Trainer(model, shown, seed=SEED, progress=progress).run()
    assert summary.psnr_test is not None  # choose_cameras holds out at least one
    return Baked(model["base"].gaussians.detached(), len(fitted), summary.psnr_test)


def joined(sets: Sequence[Gaussians]) -> Gaussians:
    """The rows of several sets in one, without channels, of SH degree 3.

    Surfels beside ellipsoids become flat ellipsoids.

    Raises:
        ValueError: no set.
    """
    if not sets:
        raise ValueError("no set to join")
    kind = Ellipsoids if any(isinstance(each, Ellipsoids) for each in sets) else Surfels
    parts = []
    for each in sets:
        tensors = {name: each[name].detach() for name in PARAMETERS}
        tensors["sh_rest"] = pad(tensors["sh_rest"], (0, 0, 0, _REST - tensors["sh_rest"].shape[1]))
        if each.axis_count < kind.axis_count:
            tensors["log_scales"] = pad(tensors["log_scales"], (0, 1), value=_FLAT)
        parts.append(tensors)
    return kind.of({name: torch.cat([part[name] for part in parts]).clone() for name in PARAMETERS})


def largest(gaussians: Gaussians, most: int) -> Gaussians:
    """Those ``most`` that cover the most: by opacity times area, in their order."""
    if len(gaussians) <= most:
        return gaussians
    area = gaussians.log_scales.detach().sort(dim=1).values[:, -2:].sum(1)
    cover = torch.nn.functional.logsigmoid(gaussians.opacity_logits.detach()) + area
    kept = cover.topk(most).indices.sort().values
    return gaussians.like({name: tensor.detach()[kept] for name, tensor in gaussians.items()})


_FLAT = math.log(1e-6)
_STAGE = "bake"


def _build(setup: Setup) -> Model:
    """Raises ValueError: a baked model needs the Gaussians it begins with."""
    raise ValueError(f"method {setup.spec.name} is composed by rtgs.export.bake alone")


_SPEC = MethodSpec("baked", (StageSpec(_STAGE),), _build)


def _model(setup: Setup, rows: Gaussians) -> Model:
    """One base set that begins with ``rows``."""
    kind = SURFELS if isinstance(rows, Surfels) else ELLIPSOIDS
    base = BaseSet(setup, kind)
    base.set = GaussianSet(
        base.name,
        rows,
        optimizer=setup.settings.optimizer,
        density=setup.settings.density,
        means_lr_steps=setup.schedule.means_lr_steps,
        extent=setup.scene.extent,
    )
    return Model(setup, (base,))


def _view(camera: Camera, image: Tensor) -> View:
    return View(camera, image, None, None, camera.name)
