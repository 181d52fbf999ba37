"""One set that is fitted to pictures of another model."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rtgs.export.bake import SH_DEGREE, BakeSettings, bake, choose_cameras, joined, largest
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.primitives import PARAMETERS
from rtgs.gaussians.surfels import Surfels
from rtgs.render.orbit import Orbit, Picture, orbit_cameras
from rtgs.render.settings import RenderSettings
from rtgs.render.splats import render_splats
from rtgs.scenes.scene import Scene, View


def some(kind, count, degree=0, seed=0):
    random = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=random)  # noqa: E731
    return kind(
        means=0.4 * draw(count, 3),
        log_scales=0.2 * draw(count, kind.axis_count) - 1.8,
        quaternions=draw(count, 4),
        opacity_logits=draw(count) + 2,
        sh_dc=draw(count, 3),
        sh_rest=0.1 * draw(count, (degree + 1) ** 2 - 1, 3),
    )


def scene_of(cameras, tests=2):
    view = lambda camera: View(camera, torch.zeros(3, 24, 32), None, None, camera.name)  # noqa: E731
    views = [view(replace(camera, name=f"{index:02d}")) for index, camera in enumerate(cameras)]
    return Scene("s", tuple(views[tests:]), tuple(views[:tests]), torch.zeros(0, 3), torch.zeros(0, 3), 3.0, "x")


@pytest.fixture(scope="module")
def scene():
    orbit = Orbit(torch.zeros(3, dtype=torch.float64), 3.0, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    return scene_of(orbit_cameras(orbit, Picture(32, 24, 40.0), 12))


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
def test_a_fit_comes_nearer_to_what_it_is_fitted_to(scene, kind):
    truth = some(kind, 40, degree=1)
    begin = joined([truth.like({**dict(truth.items()), "sh_dc": torch.zeros(40, 3)})])
    cameras = choose_cameras(scene)
    shown = lambda camera: render_splats(truth, camera, near=0.06).clamp(0, 1)  # noqa: E731
    fitted, held = ([(camera, shown(camera)) for camera in each] for each in (cameras.fitted, cameras.held))
    before = begin.detached()
    settings = BakeSettings(steps=60)
    found = bake(scene, fitted, held, begin, RenderSettings(), settings)
    grey = sum(float((render_splats(begin, c, near=0.06).clamp(0, 1) - image).square().mean()) for c, image in held)
    assert found.psnr > -10 * torch.tensor(grey / len(held)).log10().item() + 3
    assert type(found.gaussians) is kind
    assert found.gaussians.sh_degree == SH_DEGREE
    assert found.views == len(cameras.fitted)
    assert all(torch.equal(begin[name], before[name]) for name in PARAMETERS)
    again = bake(scene, fitted, held, begin, RenderSettings(), settings)
    assert all(torch.equal(again.gaussians[name], found.gaussians[name]) for name in PARAMETERS)


def test_no_more_gaussians_than_asked_for(scene):
    cameras = choose_cameras(scene)
    grey = [(camera, torch.full((3, 24, 32), 0.5)) for camera in cameras.fitted]
    found = bake(scene, grey, grey[:1], some(Surfels, 50), RenderSettings(), BakeSettings(steps=20, most=12))
    assert 1 <= len(found.gaussians) <= 12


def test_cameras_of_tests_are_held_out_and_others_lie_between_those_of_the_training(scene):
    chosen = choose_cameras(scene)
    assert [camera.name for camera in chosen.held] == ["00", "01"]
    assert len(chosen.fitted) == 20
    places = torch.stack([camera.center for camera in chosen.fitted])
    tests = torch.stack([camera.center for camera in chosen.held])
    assert (torch.cdist(places, tests) > 1e-3).all()
    assert (torch.cdist(places[10:], places[:10]).amin(1) > 1e-3).sum() >= 8


def test_without_test_views_some_between_are_held_out(scene):
    chosen = choose_cameras(replace(scene, train=scene.test + scene.train, test=()))
    assert len(chosen.held) == 2
    assert not {id(camera) for camera in chosen.held} & {id(camera) for camera in chosen.fitted}
    single = choose_cameras(replace(scene, train=scene.train[:1], test=()))
    assert len(single.fitted) == len(single.held) == 1


def test_sets_of_both_kinds_become_ellipsoids():
    both = joined([some(Surfels, 3, degree=1), some(Ellipsoids, 2, degree=0)])
    assert isinstance(both, Ellipsoids)
    assert (len(both), both.sh_degree) == (5, SH_DEGREE)
    assert (both.log_scales[:3, 2] < -13).all()
    assert isinstance(joined([some(Surfels, 3)]), Surfels)
    with pytest.raises(ValueError, match="no set"):
        joined([])


def test_the_largest_are_kept_in_their_order():
    rows = some(Surfels, 4)
    rows.opacity_logits = torch.zeros(4)
    rows.log_scales = torch.tensor([[0.0, 0.0], [-5.0, -5.0], [1.0, 1.0], [-9.0, -9.0]])
    kept = largest(rows, 2)
    assert torch.equal(kept.means, rows.means[[0, 2]])
    assert largest(rows, 9) is rows
