"""Fusion of analytic depths, the pieces that stay, and the files."""

import builtins
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.mesh.settings import TsdfSettings
from rtgs.mesh.triangles import TriangleMesh, in_order, read_mesh_ply, write_mesh_obj, write_mesh_ply
from rtgs.mesh.tsdf import (
    DepthView,
    MeshResult,
    blocks_near_surface,
    focus_region,
    fuse_depths,
    fusion_lengths,
    largest_pieces,
    object_fusion,
    unpacked,
    usable_depth,
)
from tests.mesh.shapes import box, camera_at, join, sphere, sphere_depths

RADIUS = 1.0


def cameras_around(count: int, distance: float = 3.0) -> list[Camera]:
    """Spread evenly over a sphere."""
    cameras = []
    for k in range(count):
        z = 1 - 2 * (k + 0.5) / count
        angle, ring = 2.39996 * k, (1 - z * z) ** 0.5
        center = distance * np.array([ring * np.cos(angle), ring * np.sin(angle), z])
        cameras.append(camera_at(center, width=128, height=112, focal=150.0))
    return cameras


def sphere_view(camera: Camera) -> DepthView:
    near, _ = sphere_depths(camera, RADIUS)
    hit = torch.isfinite(near)
    image = torch.tensor([0.2, 0.5, 0.8]).view(3, 1, 1).expand(3, *near.shape)
    return DepthView(camera, torch.where(hit, near, 0.0).float(), image, hit.float())


def fused(views: list[DepthView], settings: TsdfSettings) -> MeshResult:
    return fuse_depths(iter(views), [view.camera for view in views], settings)


def sphere_views(count: int = 20) -> list[DepthView]:
    return [sphere_view(camera) for camera in cameras_around(count)]


def test_sphere_is_recovered_within_a_voxel() -> None:
    settings = TsdfSettings(depth_trunc=6.0, voxel=6.0 / 160)
    result = fused(sphere_views(), settings)
    distance = np.linalg.norm(result.mesh.vertices, axis=1) - RADIUS
    assert np.abs(distance).mean() < 0.25 * result.voxel
    assert np.abs(distance).max() < 1.5 * result.voxel
    assert np.linalg.norm(result.mesh.vertices.mean(0)) < 0.1 * result.voxel  # half a pixel off would show here
    assert result.kept == 1
    corners = result.mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, uses = np.unique(np.sort(corners, axis=1), axis=0, return_counts=True)
    assert (uses == 2).all()  # watertight: no cracks between blocks
    volume = np.einsum("ij,ij->i", result.mesh.face_normals(), result.mesh.vertices[result.mesh.faces[:, 0]]).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)  # closed, and normals point outwards
    assert result.mesh.colors is not None
    np.testing.assert_allclose(result.mesh.colors.mean(0), [0.2, 0.5, 0.8], atol=2e-3)


def renumbered(mesh: TriangleMesh, seed: int) -> TriangleMesh:
    """The same surface with vertices and faces at random places, and faces that begin with a random corner."""
    random = np.random.default_rng(seed)
    order = random.permutation(len(mesh.vertices))
    faces = order.argsort()[mesh.faces][random.permutation(len(mesh.faces))]
    turned = (random.integers(3, size=(len(faces), 1)) + np.arange(3)) % 3
    colors = None if mesh.colors is None else mesh.colors[order]
    return TriangleMesh(mesh.vertices[order], np.take_along_axis(faces, turned, 1), colors)


def same(a: TriangleMesh, b: TriangleMesh) -> bool:
    pairs = ((a.vertices, b.vertices), (a.faces, b.faces), (a.colors, b.colors))
    return all(np.array_equal(mine, theirs) for mine, theirs in pairs)  # None equals None


def test_fusing_again_gives_the_same_bits() -> None:
    settings = TsdfSettings(depth_trunc=6.0, voxel=6.0 / 160)
    meshes = [fused(sphere_views(), settings).mesh for _ in range(3)]
    assert same(meshes[0], meshes[1])
    assert same(meshes[0], meshes[2])
    assert same(meshes[0], in_order(renumbered(meshes[0], 0)))  # whatever Open3D's threads made of it


@pytest.mark.parametrize("seed", range(3))
def test_numbers_say_nothing_of_an_ordered_mesh(seed: int) -> None:
    """Two cubes touch in four points, which are vertices of both; one vertex has no face, none a colour."""
    whole = join(sphere(1.0, rings=12), box((1, -1, -1), (2, 1, 1)), box((2, -1, -1), (3, 1, 1)))
    whole = replace(whole, vertices=np.concatenate([whole.vertices, [[0.5, 0, 0]]]), colors=None)
    found, again = in_order(whole), in_order(renumbered(whole, seed))
    assert same(found, again)
    assert len(found.vertices) == len(whole.vertices) - 1
    assert len(found.faces) == len(whole.faces)
    assert corners(found) == corners(whole)


def corners(mesh: TriangleMesh) -> list[list[tuple[float, ...]]]:
    """Of each face, from the least on in the face's own turn; sorted."""
    faces = ([tuple(mesh.vertices[number].tolist()) for number in face] for face in mesh.faces)
    return sorted(min(face[k:] + face[:k] for k in range(3)) for face in faces)


def test_no_face_is_no_surface() -> None:
    empty = in_order(TriangleMesh(np.ones((2, 3)), np.empty((0, 3))))
    assert empty.vertices.shape == empty.faces.shape == (0, 3)


def test_derived_lengths_are_those_of_2dgs() -> None:
    views = sphere_views(8)
    region = focus_region([view.camera for view in views])
    np.testing.assert_allclose(region.center, 0, atol=1e-9)
    assert region.radius == pytest.approx(3.0)
    result = fused(views, TsdfSettings(resolution=96))
    assert result.depth_trunc == pytest.approx(6.0)
    assert result.voxel == pytest.approx(6.0 / 96)
    cameras = [view.camera for view in views]
    assert fusion_lengths(cameras, TsdfSettings())[1] == pytest.approx(3.0 / 150)  # a pixel seen from the radius
    assert fusion_lengths(cameras, TsdfSettings(finest_pixels=0))[1] == pytest.approx(6.0 / 1024)


def test_parallel_axes_have_a_finite_region() -> None:
    cameras = [camera_at((x, 0, 0), (x, 5, 0)) for x in (-1.0, 0.0, 1.0)]
    region = focus_region(cameras)
    assert np.isfinite(region.center).all()
    assert region.radius < 2


def test_mask_alpha_and_truncation_cut_the_depth() -> None:
    view = sphere_view(cameras_around(3)[0])
    assert view.alpha is not None
    left = torch.zeros_like(view.alpha, dtype=torch.bool)
    left[:, :64] = True
    depth = usable_depth(DepthView(view.camera, view.depth, mask=left), 6.0, 0.5)
    assert (depth[:, 64:] == 0).all()
    assert (depth[:, :64] == view.depth[:, :64].numpy()).all()
    assert not usable_depth(DepthView(view.camera, view.depth, alpha=view.alpha * 0.4), 6.0, 0.5).any()
    assert not usable_depth(view, 1.0, 0.5).any()
    broken = view.depth.clone()
    broken[60, 60] = torch.nan
    assert usable_depth(DepthView(view.camera, broken), 6.0, 0.5)[60, 60] == 0
    with pytest.raises(ValueError, match="depth is"):
        usable_depth(DepthView(view.camera, view.depth[:5]), 6.0, 0.5)


def test_every_block_with_a_surface_point_is_found() -> None:
    view = sphere_view(cameras_around(3)[0])
    voxel = 0.004
    depth = usable_depth(view, 6.0, 0.5)
    blocks = {tuple(block) for block in unpacked(blocks_near_surface(view.camera, depth, voxel, 5.0))}
    rays = view.camera.rays(torch.float64)
    points = (rays.origin + view.depth.double()[..., None] * rays.directions)[view.depth > 0].numpy()
    assert {tuple(block) for block in np.floor(points / (8 * voxel)).astype(int)} <= blocks


def test_an_object_is_fused_in_its_box_at_a_voxel_of_its_own() -> None:
    views = sphere_views(12)
    cameras = [view.camera for view in views]
    box = np.array([[-1.1, -1.1, 0.2], [1.1, 1.1, 1.1]])  # the upper part of the ball
    pixel = 3.0 / 150  # at the box's middle, about
    settings, crop = object_fusion(TsdfSettings(depth_trunc=6.0), 40, 7, cameras, box)
    assert (settings.voxel, settings.keep_clusters) == (pytest.approx(2.2 / 40), 7)
    fine, _ = object_fusion(TsdfSettings(), 4096, 7, cameras, box)
    assert fine.voxel == pytest.approx(pixel, rel=0.1), "no finer than a pixel"
    assert object_fusion(TsdfSettings(voxel=0.3), 40, 7, cameras, box)[0].voxel == 0.3
    half = torch.zeros(112, 128, dtype=torch.bool)
    half[:, :64] = True
    for view in (views[0], replace(views[0], mask=half)):
        points = view.camera.rays(torch.float64)
        height = (points.origin + view.depth[..., None] * points.directions)[..., 2]
        mask = crop(view).mask
        assert mask is not None
        expected = (view.depth > 0) & (height >= 0.2)
        assert torch.equal(mask & (view.depth > 0), expected if view.mask is None else expected & half)
    mesh = fuse_depths(map(crop, views), cameras, settings).mesh
    assert mesh.vertices[:, 2].min() > 0.2 - 2 * settings.voxel
    assert mesh.vertices[:, 2].max() > 0.9
    assert object_fusion(TsdfSettings(), 40, 7, cameras, None)[1](views[0]) is views[0]


def test_small_pieces_go() -> None:
    large, middle, small = sphere(1.0, 16), sphere(0.5, 12, (3, 0, 0)), box((5, 5, 5), (6, 6, 6))
    mesh = join(small, large, middle)
    kept, before, after = largest_pieces(mesh, keep=50, min_triangles=50)
    assert (before, after) == (3, 2)
    assert len(kept.faces) == len(large.faces) + len(middle.faces)
    assert kept.vertices[:, 0].max() < 4
    assert len(largest_pieces(mesh, keep=1, min_triangles=0)[0].faces) == len(large.faces)
    assert len(largest_pieces(mesh, keep=0, min_triangles=0)[0].faces) == len(mesh.faces)


def test_what_cannot_be_fused_is_explained() -> None:
    view = sphere_view(cameras_around(3)[0])
    with pytest.raises(RtgsError, match="nothing to fuse"):
        fused([DepthView(view.camera, torch.zeros_like(view.depth))], TsdfSettings(depth_trunc=6.0))
    with pytest.raises(RtgsError, match="no training views"):
        fuse_depths([], [], TsdfSettings())
    with pytest.raises(ValueError, match="either every view has an image or none"):
        fused([view, DepthView(view.camera, view.depth)], TsdfSettings(depth_trunc=6.0, voxel=0.1))
    with pytest.raises(RtgsError, match="max_blocks is 10"):
        fused([view], TsdfSettings(depth_trunc=6.0, voxel=0.05, max_blocks=10))
    with pytest.raises(RtgsError, match="0 < voxel < depth_trunc"):
        fused([view], TsdfSettings(depth_trunc=0.01, voxel=0.05))
    with pytest.raises(RtgsError, match="no piece of 1000000 triangles"):
        fused([view], TsdfSettings(depth_trunc=6.0, voxel=0.1, min_triangles=1_000_000))


def test_missing_system_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    real_import = builtins.__import__

    def failing(name, *args, **kwargs):
        if name == "open3d":
            raise OSError("libusb-1.0.so.0: cannot open shared object file")
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", failing)
    with pytest.raises(RtgsError, match=r"install libusb-1\.0-0"):
        fused(sphere_views(2), TsdfSettings(depth_trunc=6.0, voxel=0.1))


def test_files_round_trip(tmp_path: Path) -> None:
    bare = sphere(1.0, 8)
    colors = np.linspace(0, 1, bare.vertices.size, dtype=np.float32).reshape(-1, 3)
    for mesh in (bare, TriangleMesh(bare.vertices, bare.faces, colors)):
        write_mesh_ply(tmp_path / "mesh.ply", mesh)
        back = read_mesh_ply(tmp_path / "mesh.ply")
        assert np.array_equal(back.vertices, mesh.vertices)
        assert np.array_equal(back.faces, mesh.faces)
        if mesh.colors is None:
            assert back.colors is None
        else:
            np.testing.assert_allclose(back.colors, mesh.colors, atol=0.5 / 255 + 1e-6)
    write_mesh_obj(tmp_path / "mesh.obj", TriangleMesh(bare.vertices, bare.faces, colors))
    lines = (tmp_path / "mesh.obj").read_text().splitlines()
    assert sum(line.startswith("v ") for line in lines) == len(bare.vertices)
    assert sum(line.startswith("f ") for line in lines) == len(bare.faces)
    assert min(int(word) for line in lines if line.startswith("f ") for word in line.split()[1:]) == 1


def test_files_that_are_no_meshes(tmp_path: Path) -> None:
    from plyfile import PlyData, PlyElement

    points = np.zeros(3, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    PlyData([PlyElement.describe(points, "vertex")]).write(str(tmp_path / "points.ply"))
    with pytest.raises(RtgsError, match="is it a point cloud"):
        read_mesh_ply(tmp_path / "points.ply")
    (tmp_path / "noise.ply").write_bytes(b"not a ply")
    with pytest.raises(RtgsError, match="not a readable PLY"):
        read_mesh_ply(tmp_path / "noise.ply")
    for names, place, corner, message in (
        ("xyz", float("nan"), 2, "broken.ply is not a usable mesh: mesh vertices hold NaN"),
        ("xyz", 0.0, 9, "broken.ply is not a usable mesh: mesh faces point to vertices"),
        ("xy", 0.0, 2, "broken.ply has vertices without x y z"),
    ):
        vertices = np.full(3, place, dtype=[(name, "f4") for name in names])
        faces = np.empty(1, dtype=[("vertex_indices", "i4", (3,))])
        faces["vertex_indices"] = [[0, 1, corner]]
        described = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
        PlyData(described).write(str(tmp_path / "broken.ply"))
        with pytest.raises(RtgsError, match=message):
            read_mesh_ply(tmp_path / "broken.ply")
    with pytest.raises(ValueError, match="faces point to vertices"):
        TriangleMesh(np.zeros((2, 3)), np.array([[0, 1, 2]]))
