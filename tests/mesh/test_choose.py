"""Which mesh stands for the object: hull, pane, TSDF or a file, and what happens when none can."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.mesh.choose import Choice, _Candidates, choose_object_mesh, read_given
from rtgs.mesh.outlines import plain_outlines
from rtgs.mesh.pane import drawn_pane, fit_pane, is_flat
from rtgs.mesh.settings import HullSettings, ObjectSettings, SurfaceSettings
from rtgs.mesh.silhouettes import MaskSet, mask_set
from rtgs.mesh.triangles import TriangleMesh, read_mesh_obj, write_mesh_obj, write_mesh_ply
from tests.mesh.shapes import box, camera_at, pane, sphere
from tests.mesh.test_hull import labelled_bottle, masks_of, ring

SETTINGS = ObjectSettings(hull=HullSettings(voxels=40), surface=SurfaceSettings(fit="carved"))


def in_front(count: int) -> list:
    """Cameras before the plane y = 0, up to 35 degrees off its normal."""
    places = np.linspace(-2.0, 2.0, count)
    return [
        replace(camera_at((x, -3.0, 0.6 * np.sin(5 * x)), width=96, height=80, focal=110), name=f"{k:02d}")
        for k, x in enumerate(places)
    ]


def no_fusion(box: np.ndarray | None) -> tuple[TriangleMesh, float]:
    raise RtgsError("nothing to fuse here")


def chosen(source: str, masks: MaskSet, settings: ObjectSettings = SETTINGS, fuse=no_fusion) -> Choice:
    return choose_object_mesh(source, masks, settings, fuse)


def test_auto_takes_a_good_hull_without_making_another() -> None:
    choice = chosen("auto", masks_of(sphere(0.8, 24), ring(24)))
    assert choice.mesh.source == "hull"
    assert not choice.mesh.flat
    assert choice.iou.mean > 0.95
    assert set(choice.candidates) == {"hull", "pane"}
    assert choice.decisions[0].what == "object mesh: hull"
    assert "silhouette IoU: hull 0.9" in choice.decisions[0].why


def test_auto_compares_silhouettes_when_the_hull_is_poor() -> None:
    body = sphere(0.8, 24)
    masks = masks_of(body, ring(24))
    boxes = []

    def fuse(box: np.ndarray | None) -> tuple[TriangleMesh, float]:
        boxes.append(box)
        return body, 0.02

    settings = replace(SETTINGS, accept=1.0)
    choice = chosen("auto", masks, settings, fuse)
    assert choice.mesh.source == "tsdf"
    assert choice.candidates["tsdf"] > choice.candidates["hull"]
    assert (boxes[0][0] < -0.8).all()
    assert (boxes[0][1] > 0.8).all()
    without = chosen("auto", masks, settings)
    assert without.mesh.source == "hull"
    assert any(each.what == "no TSDF mesh" for each in without.decisions)


def test_a_mesh_is_scored_anew_once_the_hull_knows_what_is_hidden() -> None:
    """Where a label hides a bottle, its masks have a bite; only from the carving on are such pixels left out."""
    bottle, cameras, masks, base = labelled_bottle()
    tried = _Candidates(mask_set(cameras, masks, base), SETTINGS, no_fusion)
    before = tried.score(bottle).mean
    assert tried.score(bottle).mean == before
    tried.carve()
    assert tried.score(bottle).mean > before + 0.01
    assert tried.scores_of(bottle)[1].mean == before  # with all pixels


def test_few_views_or_directions_make_no_hull() -> None:
    body = sphere(0.8, 24)
    few = masks_of(body, ring(8))
    choice = chosen("auto", few, fuse=lambda box: (body, 0.02))
    assert choice.mesh.source == "tsdf"
    assert any(each.what == "hull not chosen" and "8 masks" in each.why for each in choice.decisions)
    assert chosen("hull", few).mesh.source == "hull"  # asked for: made
    one = mask_set(ring(8), [few.views[0].mask, *[None] * 7])
    choice = chosen("auto", one, fuse=lambda box: (body, 0.02))
    assert choice.mesh.source == "tsdf"
    assert "7 views have no mask" in choice.decisions[0].why
    with pytest.raises(RtgsError, match="no mesh of the transparent object can be made"):
        chosen("auto", one)
    with pytest.raises(RtgsError, match=r"neither a hull nor a pane .*ablation=two_stages"):
        chosen("hull", one)


def test_auto_takes_no_tsdf_mesh_that_the_masks_contradict() -> None:
    """Few masks distrust the hull, but a lump elsewhere is worse; without a hull either there is no mesh."""
    body = sphere(0.8, 24)
    few = masks_of(body, ring(8))

    def lump(box: np.ndarray | None) -> tuple[TriangleMesh, float]:
        return sphere(0.3, 12, (0.5, 0, 0)), 0.02

    choice = chosen("auto", few, fuse=lump)
    assert choice.mesh.source == "hull"
    (why,) = [each.why for each in choice.decisions if each.what == "no TSDF mesh"]
    assert "silhouette IoU with the masks is 0.1" in why
    assert "mesh.object.tsdf_accept 0.5" in why
    assert chosen("auto", few, replace(SETTINGS, tsdf_accept=0.05), lump).mesh.source == "tsdf"
    assert chosen("tsdf", few, fuse=lump).mesh.source == "tsdf"  # asked for: made
    fair = chosen("auto", few, fuse=lambda box: (sphere(0.7, 24), 0.02))
    assert 0.5 < fair.candidates["tsdf"] < fair.candidates["hull"]
    assert fair.mesh.source == "tsdf", "few masks agree with any hull"
    one = mask_set(ring(8), [few.views[0].mask, *[None] * 7])
    with pytest.raises(RtgsError, match="no mesh of the transparent object can be made") as caught:
        chosen("auto", one, fuse=lump)
    assert str(caught.value).count("1 usable mask") == 1
    assert str(caught.value).count("ablation=two_stages") == 1


def test_masks_of_a_pane_give_a_pane() -> None:
    masks = masks_of(pane(1.4, 1.0), in_front(15))
    choice = chosen("auto", masks)
    assert choice.mesh.flat
    assert choice.decisions[0].what == "object mesh: a flat pane"
    assert choice.iou.mean > 0.95
    vertices = choice.mesh.mesh.vertices
    assert np.abs(vertices[:, 1]).max() < 0.08  # a pixel is 0.03 wide
    np.testing.assert_allclose(np.abs(vertices).max(0)[[0, 2]], [0.7, 0.5], atol=0.03)
    assert (choice.mesh.mesh.face_normals()[:, 1] < 0).all()  # towards the cameras
    assert not choice.mesh.inside(torch.zeros(3, 3)).any()
    solid = chosen("hull", masks, replace(SETTINGS, flat="no"))
    assert not solid.mesh.flat


def test_a_pane_can_be_asked_for_and_bodies_are_none() -> None:
    masks = masks_of(sphere(0.8, 24), ring(16))
    assert chosen("hull", masks, replace(SETTINGS, flat="yes")).mesh.flat
    assert fit_pane(plain_outlines(masks.views)).agreement < 0.85
    assert is_flat(pane(1.0, 0.7))
    assert is_flat(box((0, 0, 0), (1, 1, 0.02)))
    assert not is_flat(box((0, 0, 0), (1, 1, 0.2)))


def glass_front() -> tuple[list, list[np.ndarray], TriangleMesh]:
    """A walk along three panes with bars between them that go on beyond every picture, and the wall that they are."""
    places = np.linspace(-2.5, 2.5, 12)
    cameras = [
        replace(camera_at((x, -1.2, 0.0), (x + 0.4, 0, 0), width=96, height=60, focal=100), name=f"{k:02d}")
        for k, x in enumerate(places)
    ]
    sides = [(-6.0, -1.6), (-1.5, 0.9), (1.0, 6.0)]
    panes = [np.array([(a, 0, -3), (b, 0, -3), (b, 0, 3), (a, 0, 3)], float) for a, b in sides]
    corners = np.concatenate(panes).astype(np.float32)
    faces = np.array([[4 * k + c for c in face] for k in range(3) for face in ((0, 1, 2), (0, 2, 3))])
    return cameras, panes, TriangleMesh(corners, faces)


def test_drawn_panes_are_taken_where_masks_cannot_tell() -> None:
    """Masks of a glass front that fills the pictures say nothing about its plane; what was drawn does."""
    cameras, panes, wall = glass_front()
    masks = masks_of(wall, cameras)
    assert all(view.cut for view in masks.views)
    choice = choose_object_mesh("auto", masks, SETTINGS, no_fusion, panes)
    assert choice.mesh.flat
    assert choice.mesh.source == "given"
    assert choice.iou.mean > 0.98
    assert set(choice.candidates) == {"drawn panes"}, "nothing else is tried"
    vertices = choice.mesh.mesh.vertices
    assert np.abs(vertices[:, 1]).max() < 1e-6
    assert np.ptp(vertices[:, 0]) < 11, "what no picture shows is left out"
    assert np.abs(vertices[:, 2]).max() < 2.5
    assert (choice.mesh.mesh.face_normals()[:, 1] < 0).all()  # towards the cameras
    moved = [corners + np.array([0, 1.5, 0]) for corners in panes]
    body = masks_of(sphere(0.8, 24), ring(24))
    other = choose_object_mesh("auto", body, SETTINGS, no_fusion, moved)
    assert other.mesh.source == "hull"
    assert any(each.what == "drawn panes not taken" for each in other.decisions)
    unseen = [corners + np.array([0, 0, 1000]) for corners in panes]
    another = choose_object_mesh("auto", body, SETTINGS, no_fusion, unseen)
    assert another.mesh.source == "hull", "marks that no view shows keep nothing else from being tried"
    assert ("drawn panes not taken", "no view has any") in [(each.what, each.why[:15]) for each in another.decisions]
    with pytest.raises(RtgsError, match="no view has any of the drawn panes"):
        drawn_pane([corners - np.array([0, 50, 0]) for corners in panes], masks.views)


def test_given_meshes(tmp_path: Path) -> None:
    body = sphere(0.8, 16)
    masks = masks_of(body, ring(6))
    write_mesh_ply(tmp_path / "ball.ply", body)
    write_mesh_obj(tmp_path / "ball.obj", body)
    for name in ("ball.ply", "ball.obj"):
        choice = chosen("given", masks, replace(SETTINGS, given=str(tmp_path / name)))
        assert choice.mesh.source == "given"
        assert choice.iou.mean > 0.97
        assert choice.mesh.voxel == pytest.approx(1.6 / 40, rel=0.01)
    write_mesh_ply(tmp_path / "inward.ply", replace(body, faces=body.faces[:, ::-1]))
    turned = chosen("given", masks, replace(SETTINGS, given=str(tmp_path / "inward.ply")))
    np.testing.assert_array_equal(turned.mesh.mesh.faces, body.faces)
    assert "given mesh turned inside out" in [each.what for each in turned.decisions]
    line = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    for name, mesh, message in (
        ("far.ply", replace(body, vertices=body.vertices + 500), r"far.ply is not where the masks show .* frame"),
        ("small.ply", replace(body, vertices=0.01 * body.vertices), "small.ply is not where the masks show"),
        ("line.ply", TriangleMesh(line, np.array([[0, 1, 2]])), "holds no surface"),
    ):
        write_mesh_ply(tmp_path / name, mesh)
        with pytest.raises(RtgsError, match=message):
            chosen("given", masks, replace(SETTINGS, given=str(tmp_path / name)))
    nothing = TriangleMesh(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.int32))
    write_mesh_ply(tmp_path / "nothing.ply", nothing)
    with pytest.raises(RtgsError, match=r"no faces|holds no surface"):
        chosen("given", masks, replace(SETTINGS, given=str(tmp_path / "nothing.ply")))
    (tmp_path / "quad.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 1/1/1 2//1 -2 4\n")
    assert len(read_mesh_obj(tmp_path / "quad.obj").faces) == 2
    (tmp_path / "points.obj").write_text("v 0 0 0\n")
    (tmp_path / "zero.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 0 1 2\n")
    (tmp_path / "short.obj").write_text("v 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n")
    (tmp_path / "mesh.stl").write_text("solid")
    for path, message in (
        ("", "needs mesh.object.given"),
        (str(tmp_path / "none.ply"), "needs mesh.object.given"),
        (str(tmp_path / "mesh.stl"), "only .ply and .obj"),
        (str(tmp_path / "points.obj"), "no faces"),
        (str(tmp_path / "zero.obj"), "zero.obj is not a readable OBJ: 'f 0 1 2': vertices are counted from 1"),
        (str(tmp_path / "short.obj"), "'v 0 0': a vertex has three coordinates"),
    ):
        with pytest.raises(RtgsError, match=message):
            read_given(path)


def test_misspelt_choices() -> None:
    masks = masks_of(sphere(0.8, 16), ring(6))
    with pytest.raises(RtgsError, match=r"mesh\.source='hul' is unknown: .*did you mean 'hull'"):
        chosen("hul", masks)
    with pytest.raises(ValueError, match=r"mesh\.object\.flat='maybe' is unknown: choose one of auto, yes, no"):
        replace(SETTINGS, flat="maybe")
