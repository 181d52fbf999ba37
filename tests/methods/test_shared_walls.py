"""Rays that neighbouring pixels of glass share in training, where its walls reflect little."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from glass_cases import GlassScene, begun, fresnel, glass_scene

from rtgs.methods import Mode
from rtgs.methods.model import Model
from rtgs.methods.parts.glass import Glass
from rtgs.methods.parts.mirror import Mirror
from rtgs.methods.parts.wall_light import InnerRays
from rtgs.optics.dielectric import wall_reflectance
from rtgs.optics.settings import WallSettings

STEP = 40
BELOW = 0.2


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


def rendered(method: Model, made: GlassScene, mode: Mode):
    view = made.scene.train[0]
    return method.render(view.camera, STEP, mode, mask=view.mask)


def inner_rays(method: Model, made: GlassScene) -> InnerRays:
    glass, view = method.parts["glass"], made.scene.train[0]
    assert isinstance(glass, Glass)
    assert glass.wall is not None
    assert glass.guide is not None
    assert glass.wall._inner is not None
    paths = glass.wall._inner.paths(view.camera, glass.guide)
    return InnerRays(torch.arange(len(paths.pixels)), paths)


@pytest.mark.parametrize("bounces", [1, 2])
def test_a_stretch_shows_a_ray_of_its_block_and_bright_ones_their_own(made: GlassScene, bounces: int):
    whole = inner_rays(begun(fresnel(bounces=bounces), made), made)
    width = made.scene.train[0].camera.width
    legs = whole.paths.legs
    level = torch.cat([torch.full((len(leg.length),), k) for k, leg in enumerate(legs)])
    pixels, every = whole.paths.pixels, []
    for leg in legs:
        pixels = pixels[leg.parent]
        every.append(pixels)
    pixels = torch.cat(every)
    cosine = torch.zeros(int(whole.paths.pixels.max()) + 1).index_copy(0, whole.paths.pixels, whole.paths.cosine)
    low = wall_reflectance(cosine, 1.5)[pixels] < BELOW
    assert 0.1 < float(low.float().mean()) < 1
    seen = torch.zeros(len(pixels))
    for turn in range(4):
        found = whole.share(1.5, BELOW, width, turn)
        assert found.shared is not None
        rows = found.every(found.traced(torch.arange(len(pixels))))
        seen[rows.unique()] += 1
        assert len(found.shared.own) == len(rows.unique()) < len(pixels)
        assert torch.equal(rows[~low], torch.arange(len(pixels))[~low])
        assert torch.equal(level[rows], level)
        for divided in (lambda p: p // width // 2, lambda p: p % width // 2):
            assert torch.equal(divided(pixels[rows]), divided(pixels))
        assert [len(each) for each in found.leaving()] == [len(found.shared.own)] * 2
    assert bool((seen > 0).all()), "every pixel has its turn"
    none = whole.share(1.5, 0.0, width, 0)
    assert torch.equal(none.every(none.traced(pixels)), pixels)


def test_training_traces_fewer_rays_and_pictures_as_many(made: GlassScene, monkeypatch: pytest.MonkeyPatch):
    counts: list[int] = []
    reflect = Mirror.reflect

    def counted(self: Mirror, frame, chosen, flat, more=None, bent=None):
        shared = chosen.shared
        counts.append(len(chosen.index) if shared is None else len(shared.own))
        counts.append(0 if more is None else len(more[0]))
        return reflect(self, frame, chosen, flat, more, bent)

    monkeypatch.setattr(Mirror, "reflect", counted)
    plain, shared = (begun(fresnel(shared_below=below), made) for below in (0.0, BELOW))
    with torch.no_grad():
        for mode in (Mode.TRAIN, Mode.EVALUATE):
            images = [rendered(method, made, mode).image for method in (plain, shared)]
            own, inner, fewer_own, fewer_inner = counts[-4:]
            if mode is Mode.TRAIN:
                assert fewer_own < own
                assert fewer_inner < 0.8 * inner
                assert 0 < float((images[0] - images[1]).abs().mean()) < 0.02
            else:
                assert counts[-4:-2] == counts[-2:]
                assert torch.equal(*images)


def test_what_is_shared_has_gradients_and_repeats(made: GlassScene):
    found = []
    for _ in range(2):
        method = begun(fresnel(shared_below=BELOW, index_rate=0.01), made)
        rendered(method, made, Mode.TRAIN).image.square().sum().backward()
        grads = [
            method[name].gaussians[key].grad for name in ("reflection", "transmittance") for key in ("means", "sh_dc")
        ]
        assert all(grad is not None and float(grad.abs().max()) > 0 for grad in grads)
        found.append(grads)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_a_share_is_no_more_than_all():
    with pytest.raises(ValueError, match=r"wall\.shared_below=1\.5 must be at most 1"):
        replace(WallSettings(), shared_below=1.5)
