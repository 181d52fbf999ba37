import numpy as np
import pytest

from rtgs.scenes.synthetic.description import Part, Shape
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
    "dome": (Shape("d", "dome", size=(0.5, 0, 0)), 2 * np.pi * 0.25),
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
    points, _, normals = sample_surface(build(Shape("s", "sphere", size=(2.0, 0, 0))), 20_000, rng)
    np.testing.assert_allclose((normals * points).sum(1), 2.0, atol=0.01)  # unit and outward
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 2.0, atol=5e-3)
    assert np.abs(points.mean(0)).max() < 0.05  # uniform: no bias to a pole
    assert np.mean(points[:, 2] > 1.0) == pytest.approx(0.25, abs=0.015)  # a cap of height R/2 holds a quarter


def test_joined_balls_are_one_smooth_closed_surface():
    parts = (Part(size=(0.2, 0.2, 0.2)), Part(position=(0.25, 0, 0), size=(0.15, 0.15, 0.15), blend=0.05))
    mesh = build(Shape("s", "sculpt", parts=parts, cell=0.01))
    area, cross = face_area_and_normal(mesh)
    np.testing.assert_allclose(cross.sum(0), 0, atol=1e-3)  # closed: the area vectors cancel
    assert ((cross * mesh.normals[mesh.faces].mean(1)).sum(1)[area > 1e-7] > 0).all()
    to_first = np.linalg.norm(mesh.vertices, axis=1) - 0.2
    to_second = np.linalg.norm(mesh.vertices - (0.25, 0, 0), axis=1) - 0.15
    outside = np.minimum(to_first, to_second)
    assert outside.max() < 0.05 / 4 + 1e-3  # a blend adds at most a quarter of its width
    assert outside.min() > -1e-3


def test_a_cut_takes_away_and_a_mirrored_part_is_on_both_sides():
    box = Part(form="box", size=(0.3, 0.3, 0.1))
    holes = Part(position=(0, 0.15, 0), size=(0.08, 0.08, 0.5), cut=True, mirror=True)
    mesh = build(Shape("s", "sculpt", parts=(box, holes), cell=0.01))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    volume = (np.cross(a, b) * c).sum() / 6
    # the pits are ellipsoids much longer than the plate is thick: nearly cylinders
    assert volume == pytest.approx(0.6 * 0.6 * 0.2 - 2 * np.pi * 0.08**2 * 0.2, rel=0.02)
    assert abs((mesh.vertices[:, 1] > 0).mean() - 0.5) < 0.02


def test_an_outline_is_a_plate_inside_its_corners():
    corners = ((0.5, -0.3), (0.5, 0.3), (-0.5, 0.3), (-0.5, -0.3))
    mesh = build(Shape("s", "sculpt", parts=(Part(form="outline", outline=corners, size=(0, 0.2, 0)),), cell=0.02))
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    np.testing.assert_allclose(high, -low, atol=0.02)
    np.testing.assert_allclose(high, (0.5, 0.2, 0.3), atol=0.03)
    assert np.abs(mesh.vertices[:, [0, 2]] / (0.5, 0.3)).sum(1).max() < 1.85, "corners are rounded"


def test_nothing_left_is_an_error():
    with pytest.raises(ValueError, match="nothing is left of its parts"):
        build(Shape("ghost", "sculpt", parts=(Part(size=(0.1, 0.1, 0.1)), Part(size=(0.3, 0.3, 0.3), cut=True))))


def test_box_mapped_uvs_are_metres():
    mesh = build(Shape("s", "sculpt", parts=(Part(size=(0.3, 0.3, 0.3)),), cell=0.02))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    ua, ub, uc = (mesh.uvs[mesh.faces[:, k]] for k in range(3))
    d1, d2 = ub - ua, uc - ua
    flat = np.abs(d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]) / 2
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    share = flat[area > 1e-8] / area[area > 1e-8]
    assert share.max() <= 1 + 1e-5
    assert share.min() > 1 / np.sqrt(3) - 1e-3  # a face is seen along the axis it faces most


def test_kernels_stay_near_their_heap():
    shape = Shape("p", "kernels", profile=((0.1, 0.0), (0.2, 0.3)), size=(0.03, 0, 0), count=40)
    mesh = build(shape)
    radius = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1])
    assert (radius < np.interp(mesh.vertices[:, 2], (0, 0.3), (0.1, 0.2)) + 2 * 0.03).all()
    assert mesh.vertices[:, 2].min() > -0.05
    assert mesh.vertices[:, 2].max() < 0.35


def test_copies_are_the_same_thing_elsewhere():
    once = build(Shape("b", "box", size=(0.1, 0.2, 0.3), turn=20, position=(1, 2, 3)))
    twice = build(Shape("b", "box", size=(0.1, 0.2, 0.3), turn=20, position=(1, 2, 3), copies=((4, 5, 6),)))
    count = len(once.vertices)
    assert len(twice.vertices) == 2 * count
    np.testing.assert_array_equal(twice.vertices[:count], once.vertices)
    np.testing.assert_allclose(twice.vertices[count:], once.vertices + 3, atol=1e-12)


def test_an_arc_of_a_lathe_ends_where_it_is_told():
    mesh = build(Shape("label", "lathe", profile=((0.3, 0.0), (0.3, 0.5)), arc=90))
    angle = np.degrees(np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]))
    assert angle.min() == pytest.approx(0, abs=1e-9)
    assert angle.max() == pytest.approx(90)


def test_a_dome_is_seen_from_inside_and_ends_at_the_horizon():
    mesh = build(Shape("sky", "dome", size=(5.0, 0, 0)))
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 5)
    assert ((mesh.normals * mesh.vertices).sum(1) < 0).all()
    assert mesh.vertices[:, 2].min() == pytest.approx(0)
