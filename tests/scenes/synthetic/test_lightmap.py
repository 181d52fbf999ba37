"""Light maps against path tracing: the same pictures, layer by layer, from one light computation for all views."""

import numpy as np
import pytest

pytest.importorskip("mitsuba", reason="path tracing needs the extra 'synthetic'")

from rtgs.scenes.synthetic.description import Material, SceneDescription, Shape, Viewpoints
from rtgs.scenes.synthetic.geometry import build
from rtgs.scenes.synthetic.lightmap import LightmapSettings, _spread
from rtgs.scenes.synthetic.render import PathTracer
from rtgs.scenes.synthetic.variants import find_llvm
from rtgs.scenes.synthetic.viewpoints import cameras
from rtgs.scenes.truth import srgb_from_linear

vectorised = pytest.mark.skipif(find_llvm() is None, reason="light maps need the vectorised variant, which needs LLVM")
FEW = LightmapSettings(most=500, samples=48)


def described(*shapes, light=(0.0, 0.0, 0.0)):
    return SceneDescription("test", "Test", shapes, Viewpoints(count=6, radius=(1.6, 1.8), rings=1), light)


@vectorised
def test_matte_ball_under_an_even_sky_sends_out_reflectance_times_sky():
    ball = Shape("ball", "sphere", size=(0.5, 0, 0), material=Material(texture="checker"))
    scene = described(ball, light=(2.0, 1.0, 0.5))
    tracer = PathTracer(scene, lightmap=FEW)
    camera = cameras(scene.viewpoints, 32, 24)[0]
    inside = tracer.geometry(camera).depth > 0
    inside[:, 1:] &= inside[:, :-1]
    inside[:, :-1] &= inside[:, 1:]
    layers = tracer.layers(camera, 64)
    ratio = layers.diffuse[inside].mean(0) / np.array((2.0, 1.0, 0.5))
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=1e-3)  # grey reflectance: the colour is the sky's
    assert 0.27 < ratio.mean() < 0.7  # between the checker's reflectances
    assert layers.reflected.max() == 0
    assert layers.transmitted.max() == 0


@vectorised
def test_pictures_are_those_of_path_tracing():
    room = Shape("room", "box", size=(2.5, 2.5, 2.0), inward=True, material=Material(texture="mural"))
    lamps = [
        Shape(
            f"lamp{k}", "plane", position=(x, 0, 0.4), size=(1.2, 1.2, 0), tilt=90, turn=turn, emission=(3.0, 3.0, 3.0)
        )
        for k, (x, turn) in enumerate(((-2.45, 90), (2.45, -90)))
    ]
    glass = Shape("glass", "sphere", size=(0.4, 0, 0), material=Material(kind="thin_glass"))
    core = Shape("core", "sphere", size=(0.2, 0, 0), material=Material(color=(0.7, 0.3, 0.2)))
    mirror = Shape(
        "mirror", "sphere", position=(0.1, 0.7, 0), size=(0.3, 0, 0), material=Material("mirror", roughness=0)
    )
    glossy = Shape("gloss", "sphere", position=(0.1, -0.7, 0), size=(0.3, 0, 0), material=Material("glossy"))
    scene = described(room, *lamps, glass, core, mirror, glossy)
    camera = cameras(scene.viewpoints, 32, 24)[0]
    mapped, traced = PathTracer(scene, lightmap=FEW).layers(camera, 64), PathTracer(scene).layers(camera, 256)
    for name in ("diffuse", "reflected", "transmitted"):
        assert getattr(mapped, name).mean() == pytest.approx(getattr(traced, name).mean(), rel=0.03), name
    error = srgb_from_linear(mapped.image) - srgb_from_linear(traced.image)
    assert -10 * np.log10(np.mean(error**2)) > 29  # mostly the edges of 768 coarse pixels


def test_light_spreads_over_neighbours_that_face_the_same_way():
    mesh = build(Shape("plate", "box", size=(0.5, 0.5, 0.01)))
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [np.column_stack((rng.uniform(-0.5, 0.5, (300, 2)), np.full(300, z))) for z in (0.01, -0.01)]
    )
    normals = np.repeat([(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)], 300, axis=0)
    light = np.repeat([(1.0, 1.0, 1.0), (0.0, 0.0, 0.0)], 300, axis=0)
    spread = _spread(mesh, points, normals, light, neighbors=6)
    np.testing.assert_allclose(spread[mesh.normals[:, 2] > 0.9], 1, atol=1e-3)  # the dark lower side does not leak
    np.testing.assert_allclose(spread[mesh.normals[:, 2] < -0.9], 0, atol=1e-3)


def test_the_scalar_variant_traces_every_path():
    ball = Shape("ball", "sphere", size=(0.5, 0, 0))
    tracer = PathTracer(described(ball, light=(1.0, 1.0, 1.0)), variant="scalar_rgb", lightmap=LightmapSettings())
    assert tracer.lightmap is None
    assert "light map" not in tracer.renderer
