"""The light of the generator against closed forms, in the scalar variant, which every machine has."""

import numpy as np
import pytest
import torch

pytest.importorskip("mitsuba", reason="path tracing needs the extra 'synthetic'")

from rtgs.core.cameras import Camera
from rtgs.scenes.synthetic.capture import to_srgb
from rtgs.scenes.synthetic.description import Material, SceneDescription, Shape, Viewpoints
from rtgs.scenes.synthetic.render import PathTracer
from rtgs.scenes.synthetic.variants import LLVM_VARIANT, SCALAR_VARIANT, choose_variant
from rtgs.scenes.synthetic.viewpoints import look_at

VARIANTS = sorted({SCALAR_VARIANT, choose_variant()[0]})
SKY = 0.5


def seen_from(position, target, pixels=1, field_of_view=1e-3, name="probe") -> Camera:
    """A square camera; by default one pixel of next to no width, a ray."""
    rotation, translation = look_at(np.asarray(position, float), np.asarray(target, float))
    focal = 0.5 * pixels / np.tan(np.radians(field_of_view) / 2)
    center = pixels / 2
    pose = torch.from_numpy(rotation), torch.from_numpy(translation)
    return Camera(*pose, focal, focal, center, center, pixels, pixels, name=name)


def tracer(*shapes, light=(SKY, SKY, SKY), variant=SCALAR_VARIANT) -> PathTracer:
    return PathTracer(SceneDescription("test", "Test", shapes, Viewpoints(), light), variant=variant)


def fresnel(cosine: float, ior: float) -> float:
    """Unpolarised reflectance of one interface, from Fresnel's equations (Hecht, Optics, 4.6)."""
    inside = np.sqrt(1 - (1 - cosine**2) / ior**2)
    across = (cosine - ior * inside) / (cosine + ior * inside)
    along = (ior * cosine - inside) / (ior * cosine + inside)
    return 0.5 * (across**2 + along**2)


def pane(kind="thin_glass", **material) -> Shape:
    """A large pane in the plane z = 0."""
    return Shape("pane", "plane", size=(50.0, 50.0, 0.0), material=Material(kind=kind, **material))


def at_angle(degrees: float, distance: float = 2.0) -> Camera:
    angle = np.radians(degrees)
    return seen_from((distance * np.sin(angle), 1e-6, distance * np.cos(angle)), (0, 0, 0))


@pytest.mark.parametrize(("ior", "variant"), [(1.3, SCALAR_VARIANT), *((1.5, variant) for variant in VARIANTS)])
@pytest.mark.parametrize("degrees", [0.0, 45.0, 80.0])
def test_a_thin_pane_reflects_as_two_interfaces_do(degrees, ior, variant):
    layers = tracer(pane(ior=ior), variant=variant).layers(at_angle(degrees), samples=4)
    single = fresnel(np.cos(np.radians(degrees)), ior)
    expected = 2 * single / (1 + single)  # R + T^2 R + T^2 R^3 + ... with T = 1 - R
    np.testing.assert_allclose(layers.reflected[0, 0], SKY * expected, rtol=1e-4)
    np.testing.assert_allclose(layers.transmitted[0, 0], SKY * (1 - expected), rtol=1e-4)
    assert layers.diffuse.max() == 0


@pytest.mark.parametrize("degrees", [0.0, 45.0, 80.0])
def test_solid_glass_reflects_as_one_interface_does(degrees):
    block = Shape("block", "box", size=(50.0, 50.0, 1.0), position=(0, 0, -1.0), material=Material(kind="glass"))
    layers = tracer(block).layers(at_angle(degrees), samples=4)
    expected = fresnel(np.cos(np.radians(degrees)), 1.5)
    np.testing.assert_allclose(layers.reflected[0, 0], SKY * expected, rtol=1e-4)
    assert layers.diffuse.max() == 0


def test_a_mirror_shows_what_lies_in_the_mirrored_direction():
    """A small lamp where the law of reflection puts it is seen in the mirror, and just beside it there is none."""
    mirror = pane("mirror", roughness=0.0, color=(1.0, 1.0, 1.0))
    angle = np.radians(35)
    place = 3 * np.array([-np.sin(angle), 0, np.cos(angle)])
    lamp = Shape("lamp", "sphere", position=tuple(place), size=(0.05, 0, 0), emission=(1.0, 1.0, 1.0))
    scene = tracer(mirror, lamp, light=(0.0, 0.0, 0.0))
    hit = scene.layers(at_angle(35.0), samples=4)
    assert hit.reflected.min() > 0.85  # silver
    assert hit.diffuse.max() == hit.transmitted.max() == 0
    assert scene.layers(at_angle(37.0), samples=4).image.max() == 0  # 2 degrees are twice the lamp's radius there


def furnished(variant=SCALAR_VARIANT) -> PathTracer:
    """Glass, gloss, a mirror and matte walls around them, lit by a lamp."""
    walls = Shape("walls", "box", size=(3, 3, 3), inward=True, material=Material(texture="checker"))
    lamp = Shape("lamp", "plane", position=(0, 0, 2.9), size=(1.5, 1.5, 0), tilt=180, emission=(4.0, 4.0, 4.0))
    ball = Shape("ball", "sphere", position=(0, 0.45, 0), size=(0.35, 0, 0), material=Material(kind="thin_glass"))
    core = Shape("core", "sphere", position=(0, 0.45, 0), size=(0.15, 0, 0), material=Material(color=(0.8, 0.2, 0.1)))
    gloss = Shape("gloss", "sphere", position=(0, -0.4, 0.3), size=(0.3, 0, 0), material=Material(kind="glossy"))
    chrome = Shape("chrome", "sphere", position=(0, -0.3, -0.5), size=(0.3, 0, 0), material=Material(kind="mirror"))
    return tracer(walls, lamp, ball, core, gloss, chrome, light=(0.02, 0.02, 0.02), variant=variant)


@pytest.fixture(scope="module")
def room() -> PathTracer:
    return furnished()


VIEW = seen_from((2.6, 0.1, 0.4), (0, 0, 0), pixels=24, field_of_view=45.0)


def reference(room: PathTracer, samples: int) -> np.ndarray:
    """Mitsuba's own image of the room from VIEW with its own camera, film and unsplit integrator."""
    import mitsuba as mi

    mi.set_variant(room.variant)
    to_world = np.eye(4)
    to_world[:3, :3] = VIEW.rotation.numpy().T @ np.diag([-1.0, -1.0, 1.0])  # its camera: x left, y up, z forward
    to_world[:3, 3] = VIEW.center.numpy()
    sensor = {"type": "perspective", "fov": 45.0, "to_world": mi.ScalarTransform4f(to_world), "near_clip": 1e-3}
    film = {"type": "hdrfilm", "width": 24, "height": 24, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    integrator = mi.load_dict({"type": "volpath", "max_depth": 8, "rr_depth": 4})
    camera = mi.load_dict(sensor | {"film": film})
    return np.array(mi.render(room._scene, sensor=camera, integrator=integrator, spp=samples, seed=3))


def assert_same_light(image: np.ndarray, other: np.ndarray, shapes: np.ndarray) -> None:
    """As a whole within 2 %, by object within the noise of a few dozen pixels."""
    assert image.mean() == pytest.approx(other.mean(), rel=0.02)
    for number in np.unique(shapes):
        where = shapes == number
        if where.sum() > 20:
            assert image[where].mean() == pytest.approx(other[where].mean(), rel=0.1), number


def test_the_layers_add_up_to_the_unsplit_image_in_linear_light(room):
    """Against Mitsuba's own renderer, which knows nothing of layers."""
    assert_same_light(room.layers(VIEW, samples=36).image, reference(room, 196), room.geometry(VIEW).shape)


@pytest.mark.skipif(len(VARIANTS) == 1, reason="no LLVM here, there is one variant")
def test_both_variants_give_the_same_layers(room):
    scalar, vectorised = room.layers(VIEW, samples=36), furnished(LLVM_VARIANT).layers(VIEW, samples=36)
    for layer in ("diffuse", "reflected", "transmitted"):
        one, other = getattr(scalar, layer), getattr(vectorised, layer)
        assert one.mean() == pytest.approx(other.mean(), rel=0.1), layer
    assert_same_light(scalar.image, vectorised.image, room.geometry(VIEW).shape)


def test_each_layer_is_where_its_light_path_is(room):
    layers, shapes = room.layers(VIEW, samples=16), room.geometry(VIEW).shape
    names = [shape.name for shape in room.description.shapes]
    inner = {name: eroded(shapes == number) for number, name in enumerate(names)}  # a pixel's square may meet two

    def light(layer, name):
        return layer[inner[name]].mean()

    assert light(layers.diffuse, "walls") > 0.01
    assert light(layers.reflected, "walls") == light(layers.transmitted, "walls") == 0
    assert light(layers.reflected, "ball") > 0.005
    assert light(layers.transmitted, "ball") > 0.01
    assert light(layers.diffuse, "ball") == 0
    assert light(layers.reflected, "gloss") > 0.005
    assert light(layers.diffuse, "gloss") > 0.01
    assert light(layers.transmitted, "gloss") == 0
    assert light(layers.reflected, "chrome") > 0.01
    assert light(layers.diffuse, "chrome") == light(layers.transmitted, "chrome") == 0


def eroded(mask: np.ndarray) -> np.ndarray:
    from scipy.ndimage import binary_erosion

    return binary_erosion(mask, np.ones((3, 3)))


def test_the_same_seed_gives_the_same_light_and_another_stream_does_not(room):
    first, again, other = (room.layers(VIEW, samples=4, stream=stream).image for stream in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


@pytest.mark.skipif(len(VARIANTS) == 1, reason="no LLVM here, there is one variant")
def test_both_variants_see_the_same_geometry():
    ball = Shape("ball", "sphere", size=(0.5, 0, 0), material=Material(kind="thin_glass"))
    one, other = (tracer(ball, pane("diffuse"), variant=v).geometry(VIEW) for v in (SCALAR_VARIANT, LLVM_VARIANT))
    np.testing.assert_array_equal(one.shape, other.shape)
    np.testing.assert_allclose(one.depth, other.depth, rtol=1e-5)
    np.testing.assert_allclose(one.second_depth, other.second_depth, rtol=1e-4)
    np.testing.assert_allclose(one.normal, other.normal, atol=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_depths_and_normals_are_those_of_an_analytic_sphere(variant):
    center, radius = np.array([0.1, -0.05, 0.2]), 0.6
    ball = Shape("ball", "sphere", position=tuple(center), size=(radius, 0, 0), material=Material(kind="thin_glass"))
    camera = seen_from((2.0, 0.5, 0.9), (0, 0, 0), pixels=40, field_of_view=40.0)
    geometry = tracer(ball, variant=variant).geometry(camera)
    rays = camera.rays(torch.float64)
    direction = rays.directions.reshape(-1, 3).numpy()
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    offset = center - camera.center.numpy()
    along = unit @ offset
    half = np.sqrt(np.maximum(radius**2 - (offset @ offset - along**2), 0)).reshape(40, 40)
    z = (unit @ camera.rotation.numpy()[2]).reshape(40, 40)
    along = along.reshape(40, 40)
    inner = half > 0.25 * radius  # the mesh is a polyhedron: its silhouette is not the sphere's
    tolerance = 2e-3 * radius / 0.25  # sagitta of 64 x 128 facets, seen obliquely
    np.testing.assert_allclose(geometry.depth[inner], ((along - half) * z)[inner], atol=tolerance)
    np.testing.assert_allclose(geometry.second_depth[inner], ((along + half) * z)[inner], atol=tolerance)
    outside = (half == 0) & ~eroded_around(half > 0)
    assert (geometry.depth[outside] == 0).all()
    assert (geometry.shape[outside] == -1).all()
    hit = camera.center.numpy() + unit * (along - half).reshape(-1, 1)
    normal = ((hit - center) / radius @ camera.rotation.numpy().T).reshape(40, 40, 3)
    cosine = (geometry.normal * normal).sum(-1)[inner]
    assert cosine.min() > np.cos(np.radians(1.0))


def eroded_around(mask: np.ndarray) -> np.ndarray:
    from scipy.ndimage import binary_dilation

    return binary_dilation(mask, np.ones((3, 3)))


def test_srgb_of_white_sky_is_white():
    assert (to_srgb(tracer(pane(), light=(1.0, 1.0, 1.0)).image(at_angle(30.0), 4)) == 255).all()
