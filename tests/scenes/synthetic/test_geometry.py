import numpy as np
import pytest

from rtgs.scenes.synthetic.description import Shape
from rtgs.scenes.synthetic.geometry import build, sample_surface


def face_area_and_normal(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    return np.linalg.norm(cross, axis=1) / 2, cross


SHAPES = {
    "sphere": (Shape("s", "sphere", size=(0.5, 0, 0)), 4 * np.pi * 0.25),
    "box": (Shape("b", "box", size=(0.5, 1.0, 1.5), turn=30, tilt=10), 2 * (1 * 2 + 2 * 3 + 1 * 3)),
    "room": (Shape("r", "box", size=(1, 1, 1), inward=True), 24.0),
    "cylinder": (Shape("c", "lathe", profile=((0.3, 0.0), (0.3, 2.0))), 2 * np.pi * 0.3 * 2.0),
    "plane": (Shape("p", "plane", size=(1.0, 2.0, 0.0)), 8.0),
}


@pytest.mark.parametrize("name", SHAPES)
def test_area_is_the_closed_form(name):
    shape, area = SHAPES[name]
    assert face_area_and_normal(build(shape))[0].sum() == pytest.approx(area, rel=5e-3)


@pytest.mark.parametrize("shape", [s for s, _ in SHAPES.values()] + [Shape("k", "knot", size=(0.3, 1, 1), tilt=40)])
def test_winding_agrees_with_vertex_normals(shape):
    mesh = build(shape)
    area, cross = face_area_and_normal(mesh)
    facing = (cross * mesh.normals[mesh.faces].mean(1)).sum(1)
    assert (facing[area > 1e-9] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-9)


def test_room_normals_point_inward():
    mesh = build(Shape("r", "box", size=(1, 2, 3), inward=True))
    assert ((mesh.normals * mesh.vertices).sum(1) < 0).all()


def test_samples_lie_on_the_surface_and_are_uniform():
    rng = np.random.default_rng(0)
    points, _ = sample_surface(build(Shape("s", "sphere", size=(2.0, 0, 0))), 20_000, rng)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 2.0, atol=5e-3)
    assert np.abs(points.mean(0)).max() < 0.05  # uniform: no bias to a pole
    assert np.mean(points[:, 2] > 1.0) == pytest.approx(0.25, abs=0.015)  # a cap of height R/2 holds a quarter
