"""Small motions of the training cameras: exact with the losses, found again where they are known, refused with rays."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from photo_cases import misplaced, photographed, plain, steady, trained
from torch import Tensor
from training_cases import small_method, small_trainer

from rtgs.config import compose
from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.gaussians.surfels import Surfels, activate
from rtgs.methods import Mode, RenderOptions, create_method, find_method
from rtgs.methods import refine_pose as refine_pose_module
from rtgs.methods.parts.part import Frame
from rtgs.methods.parts.poses import as_posed
from rtgs.methods.photo_settings import PoseSettings
from rtgs.methods.refine_pose import refine_pose
from rtgs.render.buffers import RasterOptions
from rtgs.render.depth_normals import depth_normals
from rtgs.render.pose import NUMBERS, Pose, moved, seen_from
from rtgs.render.reference import surfels as reference
from rtgs.scenes.scene import Scene
from rtgs.train.losses import surface_depth
from rtgs.train.parameters import Rate
from rtgs.train.seeds import generator_for
from rtgs.train.trainer import Trainer

TOTAL = 400
FAST = PoseSettings(enabled=True, rate=1e-3, rate_end=1e-5)
SIZE = 0.02  # radians and shares of the extent: some two pixels


def fit(trainer: Trainer) -> float:
    """Mean squared error of the training views, of the photos."""
    method, step = trainer.method, trainer.schedule.total
    errors = []
    with torch.no_grad():
        for view in trainer.scene.train:
            image = method.render(view.camera, step, Mode.EVALUATE).image
            errors.append(float((image.clamp(0, 1) - view.image).square().mean()))
    return sum(errors) / len(errors)


def distance(cameras: list[Camera], scene: Scene) -> float:
    """Mean distance of camera centres from those of the scene."""
    centers = [view.camera.center for view in scene.train]
    return sum(float((one.center - other).norm()) for one, other in zip(cameras, centers, strict=True)) / len(cameras)


@pytest.mark.parametrize(("kind", "regained"), [("3dgs", 0.8), ("2dgs", 0.4)])
def test_cameras_that_are_off_cost_figures_and_learned_poses_bring_them_back(kind: str, regained: float):
    scene = photographed(kind)
    off = misplaced(scene, SIZE)
    (right, at_right), (wrong, at_wrong) = (trained(each, plain(kind), TOTAL) for each in (scene, off))
    learned, at_learned = trained(off, replace(plain(kind), poses=FAST), TOTAL)
    assert at_right.psnr_test is not None
    assert at_wrong.psnr_test is not None
    assert at_learned.psnr_test is not None
    assert at_right.psnr_test > at_wrong.psnr_test + 0.5
    assert at_learned.psnr_test > at_wrong.psnr_test + regained * (at_right.psnr_test - at_wrong.psnr_test)
    assert fit(learned) < 0.7 * fit(wrong)
    assert fit(right) < 0.7 * fit(wrong)
    poses = learned.method.parts["poses"]  # type: ignore[attr-defined]
    cameras = [poses.aim(Frame(view.camera, 0, Mode.EVALUATE, RenderOptions())).camera for view in off.train]
    assert distance(cameras, scene) < 0.8 * distance([view.camera for view in off.train], scene)
    assert any("degrees on average" in decision.why for decision in at_learned.decisions)


def test_a_test_camera_moves_as_the_nearest_have_and_no_other_camera_does():
    """By hand: one delta for all goes to the test view as it is; of single ones the nearest four count, the nearest
    most; a camera that the scene does not know stays."""
    scene = photographed("3dgs")
    method = small_trainer(scene, replace(plain("3dgs"), poses=FAST), steady(20)).method
    poses, view = method.parts["poses"], scene.test[0]
    deltas = poses.groups[0]["deltas"]

    def aimed(camera: Camera) -> Frame:
        return poses.aim(Frame(camera, 0, Mode.TRAIN, RenderOptions()))

    with torch.no_grad():
        deltas.copy_(torch.linspace(-0.03, 0.04, NUMBERS).expand(len(deltas), NUMBERS))
    told, own = aimed(view.camera), moved(view.camera, deltas[0].detach(), scene.extent).of(view.camera)
    assert torch.allclose(told.camera.center, own.center, atol=1e-6)
    assert torch.allclose(told.camera.rotation, own.rotation, atol=1e-6)
    assert told.pose is None  # it teaches the motions nothing
    stranger = replace(view.camera, name="elsewhere")
    assert aimed(stranger).camera is stranger

    steps = []
    for row in range(len(scene.train)):
        with torch.no_grad():
            deltas.zero_()
            deltas[row, 0] = 0.1
        steps.append(float((aimed(view.camera).camera.center - view.camera.center).norm()) / scene.extent)
    away = [float((each.camera.center - view.camera.center).norm()) for each in scene.train]
    by_distance = [steps[row] for row in sorted(range(len(away)), key=away.__getitem__)]
    assert sum(by_distance) == pytest.approx(0.1, rel=1e-4)
    assert min(by_distance[:4]) > 0
    assert max(by_distance[4:]) == 0
    assert by_distance[0] > by_distance[3]


def test_the_pose_of_a_test_view_is_refined_with_the_gaussians_as_they_are():
    scene = photographed("3dgs")
    trainer, _ = trained(scene, plain("3dgs"), TOTAL)
    view = scene.test[0]
    delta = 0.01 * torch.randn(NUMBERS, generator=torch.Generator().manual_seed(4))
    off = replace(view, camera=moved(view.camera, delta, scene.extent).of(view.camera))
    before = {name: tensor.clone() for name, tensor in trainer.method.state().items()}
    found = refine_pose(trainer.method, off, TOTAL, steps=50)  # type: ignore[arg-type]
    assert float((found.center - view.camera.center).norm()) < 0.5 * float(
        (off.camera.center - view.camera.center).norm()
    )
    assert all(torch.equal(before[name], tensor) for name, tensor in trainer.method.state().items())
    assert all(part.gaussians.means.grad is None for part in trainer.method.sets)  # type: ignore[attr-defined]


def test_a_view_that_follows_learned_poses_is_refined_from_where_it_is_seen():
    """The photo is what the model shows from a little off the view: the refined camera shows it, no step leaves it."""
    scene = photographed("3dgs")
    method = small_trainer(scene, replace(plain("3dgs"), poses=FAST), steady(20)).method
    with torch.no_grad():
        deltas = method.parts["poses"].groups[0]["deltas"]  # type: ignore[attr-defined]
        deltas.copy_((0.05 * torch.randn(NUMBERS, generator=torch.Generator().manual_seed(2))).expand_as(deltas))

    def shown(camera: Camera) -> Tensor:
        with torch.no_grad():
            return method.render(camera, 0, Mode.EVALUATE).image

    def error(camera: Camera) -> float:
        return float((shown(camera) - photo.image).square().mean())

    view = scene.test[0]
    small = 0.01 * torch.randn(NUMBERS, generator=torch.Generator().manual_seed(4))
    photo = replace(view, image=shown(moved(view.camera, small, scene.extent).of(view.camera)))
    refined = refine_pose(method, photo, 0, steps=50)  # type: ignore[arg-type]
    assert error(refined) < 0.2 * error(view.camera)
    left = refine_pose(method, photo, 0, steps=0)  # type: ignore[arg-type]
    assert torch.allclose(left.rotation, view.camera.rotation)
    assert torch.allclose(left.translation, view.camera.translation)


def test_no_step_that_helps_leaves_the_pose():
    scene = photographed("2dgs", views=5)
    trainer = small_trainer(scene, plain("2dgs"), steady(10))
    camera = scene.test[0].camera
    with torch.no_grad():
        image = trainer.method.render(camera, 0, Mode.EVALUATE).image
    exact = replace(scene.test[0], image=image)
    found = refine_pose(trainer.method, exact, 0, steps=3)  # type: ignore[arg-type]
    assert torch.equal(found.rotation, camera.rotation)
    assert torch.equal(found.translation, camera.translation)


def test_of_the_poses_met_on_the_way_the_best_is_kept(monkeypatch):
    """Steps that are far too long lead away from a photo that no pose shows."""
    scene = photographed("2dgs", views=5)
    trainer = small_trainer(scene, plain("2dgs"), steady(10))
    camera = scene.test[0].camera

    def image_from(camera):
        with torch.no_grad():
            return trainer.method.render(camera, 0, Mode.EVALUATE).image

    noise = 0.05 * torch.randn(scene.test[0].image.shape, generator=torch.Generator().manual_seed(0))
    noisy = replace(scene.test[0], image=(image_from(camera) + noise).clamp(0, 1))
    monkeypatch.setattr(refine_pose_module, "RATE", Rate(0.2))
    found = refine_pose(trainer.method, noisy, 0, steps=4)  # type: ignore[arg-type]
    errors = [float((image_from(each) - noisy.image).abs().mean()) for each in (found, camera)]
    assert errors[0] <= errors[1] * 1.001


def test_the_gradient_of_the_losses_on_surfaces_is_that_of_finite_differences():
    """Photometric, normal consistency, distortion: the twins in float64, composed as a training view is."""
    scene = photographed("2dgs", views=5)
    view, generator = scene.train[1], torch.Generator().manual_seed(6)

    def rows(*shape: int) -> Tensor:
        return torch.randn(12, *shape, generator=generator, dtype=torch.float64)

    surfels = Surfels(0.5 * rows(3), -1 + 0.3 * rows(2), rows(4), 1 + rows(), rows(3), 0.3 * rows(15, 3))
    options = RasterOptions(depth=True, normal=True, distortion=True)

    def loss(pose: Pose) -> Tensor:
        camera = pose.of(view.camera)
        seen = seen_from(pose, activate(surfels, pose.center, 3))
        shape = (seen.means, seen.tangent_u, seen.tangent_v, seen.scales, seen.opacities, seen.colors)
        found = reference.rasterize_surfels(*shape, camera, options=options)
        assert found.normal is not None
        assert found.depth is not None
        assert found.distortion is not None
        below = depth_normals(surface_depth(found.depth, found.alpha), camera)
        bent = 1 - (found.normal * below).sum(0).mean()  # L_norm but for the factor A, which it holds constant
        return (found.features - view.image).square().mean() + 0.2 * bent + 0.1 * found.distortion.mean()

    start = 0.01 * torch.randn(NUMBERS, generator=generator, dtype=torch.float64)
    delta = start.clone().requires_grad_()
    (found,) = torch.autograd.grad(loss(moved(view.camera, delta, 1.0)), delta)
    step, expected = 1e-6, torch.zeros_like(found)
    with torch.no_grad():
        for index, unit in enumerate(torch.eye(NUMBERS, dtype=torch.float64)):
            up, down = (loss(moved(view.camera, start + sign * step * unit, 1.0)) for sign in (1, -1))
            expected[index] = (up - down) / (2 * step)
    assert float(expected.abs().max()) > 1e-3
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


@pytest.mark.parametrize("name", ["envgs", "rtgs", "rtgs_printed"])
def test_methods_that_trace_rays_refuse(name: str):
    with pytest.raises(RtgsError, match=r"method\.poses\.enabled=true, but method"):
        small_trainer(photographed("2dgs", views=4), replace(small_method(name), poses=FAST))
    with pytest.raises(RtgsError, match="train method=2dgs or 3dgs"):
        compose(["scene=demo", f"method={name}", "preset=smoke", "method.poses.enabled=true"])


def test_rays_of_a_learned_pose_are_refused():
    """A method from outside may say that it only rasterises, and trace."""
    camera = photographed("2dgs", views=4).train[0].camera
    pose = moved(camera, torch.zeros(NUMBERS, requires_grad=True), 1.0)
    with pytest.raises(RtgsError, match=r"view 'view_0' is learned \(method\.poses\.enabled\)"):
        Frame(camera, 0, Mode.TRAIN, RenderOptions(), pose=pose).rays  # noqa: B018


def test_decay_pulls_back():
    scene = photographed("2dgs", views=5)
    trainer = small_trainer(scene, replace(plain("2dgs"), poses=replace(FAST, decay=3.0)), steady(10))
    (term,) = trainer.method.loss.terms  # type: ignore[attr-defined]
    group = trainer.method.groups[0]
    with torch.no_grad():
        group["deltas"][1, 4] = 0.02  # type: ignore[index]
    rendered = trainer.method.render(scene.train[0].camera, 0, Mode.TRAIN)
    (term.weight * term.value(rendered, scene.train[0])).backward()
    gradient = group["deltas"].grad  # type: ignore[index]
    assert float(gradient[1, 4]) == pytest.approx(3.0 * 0.02)
    assert int(gradient.count_nonzero()) == 1


def test_a_border_of_poses_below_zero_is_refused():
    with pytest.raises(RtgsError, match=r"method\.poses\.learn_above"):
        PoseSettings(learn_above=-0.01)


@pytest.mark.parametrize("kind", ["2dgs", "3dgs"])
@pytest.mark.parametrize(("error", "why"), [(0.05, "unsure"), (0.03, "unsure"), (None, "does not tell")])
def test_poses_are_learned_where_they_are_unsure(kind: str, error: float | None, why: str):
    scene = replace(photographed(kind, views=7), pose_error=error)
    asked = replace(plain(kind), poses=PoseSettings(learn_above=0.03))
    method = create_method(asked, scene, steady(20), generator_for(0, "initialise"))
    learned = error == 0.05
    assert ("poses" in method.parts) == learned
    what = "poses of the capture are unsure" if learned else "no poses learned"
    (told,) = (each for each in method.decisions if each.what == what)
    assert why in told.why
    assert "method.poses.learn_above is 0.03" in told.why
    assert error is None or f"{error:.3f} pixels" in told.why


def test_nothing_is_said_of_poses_where_nobody_asked():
    scene = replace(photographed("3dgs", views=7), pose_error=1.0)
    spec = find_method("3dgs")
    assert as_posed(spec, plain("3dgs"), scene) == (plain("3dgs"), ())
    asked = replace(plain("3dgs"), poses=replace(FAST, learn_above=0.01))
    assert as_posed(spec, asked, scene) == (asked, ())  # learned anyway
    traced, border = replace(plain("3dgs"), poses=PoseSettings(learn_above=1.0)), find_method("envgs")
    for error in (None, 1.0):
        assert as_posed(border, traced, replace(scene, pose_error=error)) == (traced, ())  # it could not anyway


def test_why_unsure_poses_are_not_learned():
    scene = replace(photographed("3dgs", views=7), pose_error=1.0)
    asked = replace(plain("3dgs"), poses=PoseSettings(learn_above=0.01))
    first, second, *others = scene.train
    twin = replace(second, camera=replace(second.camera, name=first.camera.name))
    for spec, seen, why in (
        (find_method("rtgs"), scene, "method rtgs traces"),
        (find_method("3dgs"), replace(scene, train=(first, twin, *others)), "names do not tell"),
    ):
        settings, (told,) = as_posed(spec, asked, seen)
        assert settings == asked
        assert told.what == "no poses learned"
        assert "1.000 pixels" in told.why
        assert why in told.why
