"""The visual hull of analytic bodies from exact and from broken masks, with and without the base set's depth."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.hull import _asked_planes, _convex_distance, _cubes, carve_hull, most_outvoted
from rtgs.mesh.outlines import plain_outlines
from rtgs.mesh.pane import _agreements, _plane
from rtgs.mesh.score import hit_score, mesh_distance, triangle_distance
from rtgs.mesh.settings import HullSettings
from rtgs.mesh.silhouettes import MaskSet, direction_spread, focus_point, mask_set, silhouette_score
from rtgs.mesh.smoothing import main_pieces, surface_of_field, taubin, volume
from rtgs.mesh.triangles import TriangleMesh
from tests.mesh.shapes import box, camera_at, cylinder, join, sphere

COARSE = HullSettings(voxels=48)
CENTER = (0.3, -0.2, 0.5)


def ring(count: int, target=(0.0, 0.0, 0.0), distance: float = 3.0, focal: float = 110.0) -> list[Camera]:
    """Cameras on three rings above the horizon, as a person goes round a table."""
    cameras = []
    for k in range(count):
        angle, tilt = 2.39996 * k, np.radians((12, 30, 50)[k % 3])
        away = np.array([np.cos(tilt) * np.cos(angle), np.cos(tilt) * np.sin(angle), np.sin(tilt)])
        camera = camera_at(np.array(target) + distance * away, target, 96, 80, focal)
        cameras.append(replace(camera, name=f"{k:02d}"))
    return cameras


def silhouettes(mesh: TriangleMesh, cameras: Sequence[Camera]) -> list[torch.Tensor | None]:
    guide = MeshGuide(mesh, 0.0)
    return [guide.surfaces(camera).hit for camera in cameras]


def depths(mesh: TriangleMesh, cameras: Sequence[Camera]) -> list[torch.Tensor]:
    guide = MeshGuide(mesh, 0.0)
    return [torch.where(pair.hit, pair.near, 0.0) for pair in (guide.surfaces(camera) for camera in cameras)]


def masks_of(mesh: TriangleMesh, cameras: Sequence[Camera]) -> MaskSet:
    return mask_set(cameras, silhouettes(mesh, cameras))


@pytest.mark.parametrize("name", ["sphere", "cylinder", "box"])
def test_convex_bodies_from_clean_masks(name: str) -> None:
    body = {"sphere": sphere(0.8, 32), "cylinder": cylinder(0.5, 0.8), "box": box((-0.6, -0.4, -0.5), (0.5, 0.6, 0.7))}
    masks = masks_of(body[name], ring(36))
    result = carve_hull(masks, COARSE)
    assert result.outvoted <= 1
    assert silhouette_score(result.mesh, masks.views).mean > 0.97  # pixels are coarse here: 45 across the body
    assert volume(result.mesh) > 0
    found = ObjectMesh(result.mesh, "hull", result.voxel, False)
    assert found.closed
    hits = hit_score(found, body[name], ring(5, distance=3.3))
    assert hits.front > 0.95
    assert hits.second > 0.95


def test_the_hull_is_smoothed() -> None:
    """Facets of the cones and steps of the pixels: rounds of Taubin's filter bring the normals nearer to the truth."""
    masks = masks_of(sphere(0.8, 32), ring(24))
    rough, smooth = (carve_hull(masks, replace(COARSE, smoothing=rounds)).mesh for rounds in (0, 10))

    def degrees(mesh: TriangleMesh) -> float:
        normals, middle = mesh.face_normals(), mesh.vertices[mesh.faces].mean(1, dtype=np.float64)
        cosine = (normals * middle).sum(1) / np.linalg.norm(normals, axis=1) / np.linalg.norm(middle, axis=1)
        return float(np.degrees(np.arccos(cosine.clip(-1, 1))).mean())

    assert degrees(smooth) < 0.8 * degrees(rough)


def test_broken_masks_are_outvoted() -> None:
    """Three masks lack half the object: as carved they take half of it away."""
    body = sphere(0.8, 32)
    cameras = ring(36)
    broken = silhouettes(body, cameras)
    for k in (4, 17, 30):
        mask = broken[k]
        assert mask is not None
        mask[:, :48] = False
    masks = mask_set(cameras, broken)
    clean = masks_of(body, cameras).views
    strict = carve_hull(masks, replace(COARSE, outvoted=0))
    robust = carve_hull(masks, COARSE)
    assert silhouette_score(strict.mesh, clean).mean < 0.85
    assert silhouette_score(robust.mesh, clean).mean > 0.95
    assert 1 <= robust.outvoted <= 4
    assert len(robust.medians) == 1 + most_outvoted(36) == 5


def test_depth_trims_the_unseen_bottom() -> None:
    """A sphere on a table seen from above: the hull goes on below the table, the table's depth ends it."""
    body = sphere(0.6, 32, (0, 0, 0.6))
    table = box((-3, -3, -0.2), (3, 3, 0.0))
    cameras = [camera for k, camera in enumerate(ring(54, (0, 0, 0.5))) if k % 3]  # 30 and 50 degrees
    masks = silhouettes(body, cameras)
    bare = carve_hull(mask_set(cameras, masks), COARSE)
    trimmed = carve_hull(mask_set(cameras, masks, depths(table, cameras)), COARSE)
    assert bare.mesh.vertices[:, 2].min() < -0.08
    assert trimmed.mesh.vertices[:, 2].min() > -0.05  # two voxels
    assert trimmed.trimmed is not None
    assert trimmed.trimmed > 0.005
    found = [hit_score(ObjectMesh(item.mesh, "hull", item.voxel, False), body, cameras[:6]) for item in (bare, trimmed)]
    assert found[1].back > 0.97 > found[0].back
    few = carve_hull(mask_set(cameras[:12], masks[:12], depths(table, cameras[:12])), COARSE)
    assert few.trimmed is None
    assert "too few" in few.note


def test_a_cut_that_the_masks_contradict_asks_fewer_views() -> None:
    """Most depths show the table too high: where eight views must see what stays, the sphere loses its lower third."""
    body = sphere(0.6, 32, (0, 0, 0.6))
    cameras = [camera for k, camera in enumerate(ring(54, (0, 0, 0.5))) if k % 3]
    masks = silhouettes(body, cameras)
    right, wrong = (depths(box((-3, -3, -0.2), (3, 3, top)), cameras) for top in (0.0, 0.4))
    for good, asked in ((5, 4), (0, 0)):
        seen = mask_set(cameras, masks, [*right[:good], *wrong[good:]])
        strict, kept = carve_hull(seen, replace(COARSE, trim_cost=1.0)), carve_hull(seen, COARSE)
        assert (strict.trim_views, strict.note) == (8, "")
        assert strict.mesh.vertices[:, 2].min() > 0.3
        assert kept.trim_views == asked
        assert "cut off what 8 views do not see free: silhouette IoU 0." in kept.note
        assert silhouette_score(kept.mesh, seen.views).mean > silhouette_score(strict.mesh, seen.views).mean + 0.02
        lowest = kept.mesh.vertices[:, 2].min()
        assert (lowest < -0.08) if asked == 0 else (lowest < 0.05)
        assert (kept.trimmed is None) == (asked == 0)


def test_contents_do_not_hollow_the_container() -> None:
    """What stands inside is behind its own surface in every view; it stays inside the mesh."""
    body, inside = box((-0.6, -0.6, 0.0), (0.6, 0.6, 1.2)), box((-0.3, -0.3, 0.0), (0.3, 0.3, 0.9))
    table = join(box((-3, -3, -0.2), (3, 3, 0.0)), inside)
    cameras = ring(30, (0, 0, 0.5))
    result = carve_hull(mask_set(cameras, silhouettes(body, cameras), depths(table, cameras)), COARSE)
    mesh = ObjectMesh(result.mesh, "hull", result.voxel, False)
    assert mesh.inside(torch.tensor([[0.0, 0.0, 0.4], [0.1, 0.2, 0.1], [0.0, 0.0, 1.0]])).all()
    assert mesh.closed
    assert volume(result.mesh) == pytest.approx(1.2**3, rel=0.15)


def labelled_bottle() -> tuple[TriangleMesh, list, list, list]:
    """A cylinder, cameras around it, its masks with a bite where a band hides it, and depths that show the band."""
    bottle = cylinder(0.5, 0.8)
    angle = np.degrees(np.arctan2(*cylinder(0.51, 0.25).vertices[:, 1::-1].T))
    whole = cylinder(0.51, 0.25)
    label = TriangleMesh(whole.vertices, whole.faces[(np.abs(angle[whole.faces]) < 60).all(1)])
    cameras = ring(36)
    front, glass = depths(label, cameras), depths(bottle, cameras)
    masks = [(own > 0) & ~((near > 0) & (near < own)) for own, near in zip(glass, front)]
    background = depths(box((-4, -4, -1.5), (4, 4, -0.81)), cameras)
    return bottle, cameras, masks, [torch.where(near > 0, near, far) for near, far in zip(front, background)]


def test_a_label_hides_but_does_not_carve() -> None:
    """An opaque band round a third of a cylinder is a bite in a third of the masks; its depth tells it from the air."""
    bottle, cameras, masks, base = labelled_bottle()
    without = carve_hull(mask_set(cameras, masks), COARSE)
    result = carve_hull(mask_set(cameras, masks, base), COARSE)
    found = [hit_score(ObjectMesh(item.mesh, "hull", item.voxel, False), bottle, ring(6)) for item in (without, result)]
    assert found[1].front > 0.95 > found[0].front
    assert sum(int(hidden.sum()) for hidden in result.hidden) > 100
    assert silhouette_score(result.mesh, mask_set(cameras, masks).views, result.hidden).mean > 0.95


def test_two_objects_stay_two() -> None:
    pair = join(sphere(0.4, 20, (-0.7, 0, 0)), sphere(0.35, 20, (0.7, 0.2, 0)))
    result = carve_hull(masks_of(pair, ring(36)), COARSE)
    assert result.kept == 2
    assert result.mesh.vertices[:, 0].min() < -1.0
    assert result.mesh.vertices[:, 0].max() > 0.95


def test_objects_cut_by_every_image_border() -> None:
    """Only the middle of a tall column is ever in the picture: the hull is what two fifths of the views see."""
    column = cylinder(0.4, 3.0)
    masks = masks_of(column, ring(36))
    assert masks.cut == 36
    result = carve_hull(masks, COARSE)
    height = float(np.ptp(result.mesh.vertices[:, 2]))
    assert 2.5 < height < 3.3  # of 6
    middle = result.mesh.vertices[np.abs(result.mesh.vertices[:, 2]) < 0.4]
    assert np.abs(np.linalg.norm(middle[:, :2], axis=1) - 0.4).max() < 0.08


def test_what_cannot_be_carved_is_explained() -> None:
    cameras = ring(12)
    everything = [torch.ones(80, 96, dtype=torch.bool)] * 12
    nothing = [torch.zeros(80, 96, dtype=torch.bool)] * 12
    with pytest.raises(RtgsError, match="12 masks cover the whole picture"):
        mask_set(cameras, everything)
    with pytest.raises(RtgsError, match="all 12 masks are empty"):
        mask_set(cameras, nothing)
    with pytest.raises(RtgsError, match="there are no masks"):
        mask_set(cameras, [None] * 12)
    with pytest.raises(RtgsError, match=r"mask of view '00' is \(40, 48\)"):
        mask_set(cameras, [torch.ones(40, 48, dtype=torch.bool), *nothing[1:]])
    body = silhouettes(sphere(0.8, 24), cameras)
    mixed = mask_set(cameras, [*body[:9], everything[0], nothing[0], None])
    assert (len(mixed.views), mixed.full, mixed.empty, mixed.without) == (9, 1, 1, 1)
    with pytest.raises(RtgsError, match="1 usable masks bound no volume"):
        carve_hull(mask_set(cameras, [body[0], *[None] * 11]), COARSE)
    with pytest.raises(RtgsError, match="outvoted is 12"):
        carve_hull(mask_set(cameras, body), replace(COARSE, outvoted=12))
    apart = [mask if k % 2 else torch.flip(mask, (0, 1)) for k, mask in enumerate(masks_far(cameras))]
    with pytest.raises(RtgsError, match=r"carve everything away|bound"):
        carve_hull(mask_set(cameras, apart), replace(COARSE, outvoted=0))


def masks_far(cameras: Sequence[Camera]) -> list[torch.Tensor]:
    """A small blob in one corner of every picture: no object."""
    blob = torch.zeros(80, 96, dtype=torch.bool)
    blob[:6, :6] = True
    return [blob.clone() for _ in cameras]


def test_focus_and_spread() -> None:
    masks = masks_of(sphere(0.3, 16, CENTER), ring(24, CENTER))
    np.testing.assert_allclose(focus_point(masks.views), CENTER, atol=0.02)
    assert direction_spread(masks.views) > 120
    assert direction_spread(masks.views[:1]) == 0


def test_smoothing_keeps_volume_and_pieces_are_chosen_by_it() -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 40)] * 3, indexing="ij"), axis=-1)
    rough = surface_of_field(0.7 - np.linalg.norm(grid, axis=-1), np.full(3, -1.0), 2 / 39)
    assert volume(rough) == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.01)
    assert volume(taubin(rough, 10)) == pytest.approx(volume(rough), rel=0.01)
    assert len(surface_of_field(-np.ones((4, 4, 4)), np.zeros(3), 1.0).faces) == 0
    crumbs = join(rough, sphere(0.1, 8, (2, 0, 0)), sphere(0.5, 12, (4, 0, 0)))
    kept, before, after = main_pieces(crumbs, 0.05)
    assert (before, after) == (3, 2)
    assert len(kept.faces) == len(crumbs.faces) - len(sphere(0.1, 8).faces)


def test_distances_between_meshes() -> None:
    assert mesh_distance(sphere(1.0, 48), sphere(1.1, 48), 2000).mean == pytest.approx(0.1, abs=2e-3)
    same = mesh_distance(box((0, 0, 0), (1, 1, 1)), box((0, 0, 0), (1, 1, 1)), 2000)
    assert same.mean < 1e-4  # the nearest samples may lie on another side
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 3, float)
    points = np.array([[0.2, 0.2, 0.5], [2.0, 0.0, 0.0], [-0.3, -0.4, 0.0]])
    np.testing.assert_allclose(triangle_distance(points, corners), [0.5, 1.0, 0.5])


@pytest.mark.parametrize("count", [0, 1, 2047, 5000])
def test_distance_to_a_convex_hull_is_that_to_the_nearest_of_its_planes(count: int) -> None:
    generator = np.random.default_rng(count)
    centres, points = generator.normal(size=(400, 3)), 2 * generator.normal(size=(count, 3))
    planes = ConvexHull(centres).equations.round(6)
    outside = (points[:, None] * planes[None, :, :3]).sum(2) + planes[:, 3]
    found = _convex_distance(points, centres, 0.1)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, 0.05 - outside.max(1), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("products", [1, 5000])
def test_cubes_at_a_time_change_no_bit_of_a_distance(products: int, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = np.random.default_rng(7)
    centres, points = generator.normal(size=(400, 3)), 2 * generator.normal(size=(3000, 3))
    whole = _convex_distance(points, centres, 0.1)
    monkeypatch.setattr("rtgs.mesh.hull._PRODUCTS", products)
    assert np.array_equal(_convex_distance(points, centres, 0.1), whole)
    order, starts = _cubes(points, 0.6)
    planes = generator.normal(size=(100, 4))
    counts = [asked.shape[1] for _, asked in _asked_planes(planes, points[order].T, starts)]
    assert sum(counts) == len(starts) > 100
    assert max(counts) == max(1, products // 100)


def test_threads_find_the_same_hull_and_scores() -> None:
    masks, before, found = masks_of(sphere(0.8, 32), ring(12)), torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            mesh = carve_hull(masks, COARSE).mesh
            found.append((mesh, silhouette_score(mesh, masks.views)))
    finally:
        torch.set_num_threads(before)
    (one, score), (other, again) = found
    assert np.array_equal(one.vertices, other.vertices)
    assert np.array_equal(one.faces, other.faces)
    assert score == again


def test_planes_agree_together_as_one_by_one() -> None:
    body = box((-0.5, -0.5, -0.01), (0.5, 0.5, 0.01))
    outlines = plain_outlines(masks_of(body, ring(12)).views)
    away = np.array([0.0, 0.0, 100.0])  # that no view has in its picture
    planes = [
        _plane(center, np.array(normal), 0.9) for center in (np.zeros(3), away) for normal in ((0, 0, 1), (1, 0, 0.3))
    ]
    found = _agreements(outlines, planes, 20)
    assert found == pytest.approx([_agreements(outlines, [plane], 20)[0] for plane in planes], abs=1e-6)
    assert found[0] > 0.8
    assert found[0] > found[1]
    assert found[2:] == [0.0, 0.0]
