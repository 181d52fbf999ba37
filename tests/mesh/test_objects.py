"""Several objects of glass: each connected piece has a surface of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtgs.core.errors import RtgsError
from rtgs.mesh import surface
from rtgs.mesh.container import ObjectMesh, read_object_mesh, write_object_mesh
from rtgs.mesh.pieces import joined, piece_labels, pieces, submesh
from rtgs.mesh.record import AND, CARVED
from rtgs.mesh.silhouettes import silhouette_score
from rtgs.mesh.surface import find_surface
from rtgs.mesh.triangles import TriangleMesh
from rtgs.methods.parts.vertices import why_not
from tests.mesh.shapes import box, sphere
from tests.mesh.test_faired_surface import FREE, carved, found_of


def test_each_of_two_objects_has_its_own_surface(tmp_path: Path) -> None:
    """A ball and a box that hides it from some views: neither shape is the other's."""
    ball, chest = sphere(0.35, 32, (-0.5, 0, 0)), box((0.2, -0.3, -0.35), (0.75, 0.3, 0.35))
    hull, masks = carved(joined([ball, chest]), 64)
    found = found_of(hull, masks)
    order = [float(piece.vertices[:, 0].mean()) > 0 for piece in pieces(hull.mesh)]
    assert found.kind == AND.join("planes" if right else "sphere" for right in order)
    round_one, flat_one = sorted(pieces(found.mesh), key=lambda piece: float(piece.vertices[:, 0].mean()))
    away = np.linalg.norm(round_one.vertices - [-0.5, 0, 0], axis=1)
    np.testing.assert_allclose(away, 0.35, atol=0.006)
    corners = np.stack([flat_one.vertices.min(0), flat_one.vertices.max(0)])
    np.testing.assert_allclose(corners, [[0.2, -0.3, -0.35], [0.75, 0.3, 0.35]], atol=0.006)
    assert found.fit.iou > found.fit.iou_before
    whole = ObjectMesh(found.mesh, "hull", hull.voxel, False, found.kind)
    label = piece_labels(found.mesh)
    for number, kind in enumerate(found.kind.split(AND)):
        alone = ObjectMesh(submesh(found.mesh, label == number), "hull", hull.voxel, False, kind)
        np.testing.assert_array_equal(whole.corners[label == number], alone.corners)
    write_object_mesh(tmp_path, whole)
    np.testing.assert_allclose(read_object_mesh(tmp_path).corners, whole.corners, atol=1e-6)
    assert why_not(whole) == "the object's surface is made of planes"
    with pytest.raises(RtgsError, match="2 connected pieces, its surfaces are sphere\\+free\\+free"):
        _ = replace(whole, surface="sphere+free+free").corners


def test_of_two_objects_the_one_that_masks_contradict_stays() -> None:
    hull, masks = carved(joined([sphere(0.3, 32, (-0.5, 0, 0)), sphere(0.3, 32, (0.5, 0, 0))]), 48)
    first, second = pieces(hull.mesh)

    def score(mesh: TriangleMesh):
        kept = any(np.array_equal(piece.vertices, second.vertices) for piece in pieces(mesh))
        return silhouette_score(mesh if kept else sphere(0.1, 16), masks.views)

    found = find_surface(hull, masks, FREE, score)
    assert found.kind == f"free{AND}{CARVED}"
    now = pieces(found.mesh)
    assert len(now[0].vertices) == len(first.vertices)
    assert np.abs(now[0].vertices - first.vertices).max() > 0
    np.testing.assert_array_equal(now[1].vertices, second.vertices)
    assert "object 2, carved: " in found.decision.why


def test_one_form_of_all_pieces_comes_first() -> None:
    """A speck beside a ball is no object that would change what the ball is."""
    hull, masks = carved(sphere(0.6, 24), 40)
    with_speck = replace(hull, mesh=joined([hull.mesh, sphere(0.1, 8, (0, 0, 0.75))]))
    found = found_of(with_speck, masks)
    assert (found.kind, len(pieces(found.mesh))) == ("sphere", 1)


def test_objects_share_what_a_surface_may_cost() -> None:
    """Each would be taken for itself, all together cost too much."""
    balls = [sphere(0.25, 16, (x, y, 0)) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
    hull, masks = carved(joined(balls), 48)
    exact = silhouette_score(hull.mesh, masks.views)

    def score(mesh: TriangleMesh):
        """Every piece that is not as it was carved costs .002."""
        kept = {piece.vertices.tobytes() for piece in pieces(hull.mesh)}
        changed = sum(piece.vertices.tobytes() not in kept for piece in pieces(mesh))
        return replace(exact, mean=exact.mean - 0.002 * changed)

    found = find_surface(hull, masks, replace(FREE, iou_cost=0.003), score)
    assert score(hull.mesh).mean - score(found.mesh).mean <= 0.003


def test_an_object_that_hardly_any_outline_tells_of_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    hull, masks = carved(joined([sphere(0.3, 16, (-0.5, 0, 0)), sphere(0.3, 16, (0.5, 0, 0))]), 48)
    second = pieces(hull.mesh)[1]
    made = surface.fair_surface

    def blind(mesh: TriangleMesh, *given):
        found = made(mesh, *given)
        return replace(found, unseen=0.9) if np.array_equal(mesh.vertices, second.vertices) else found

    monkeypatch.setattr(surface, "fair_surface", blind)
    found = find_surface(hull, masks, FREE, lambda mesh: silhouette_score(mesh, masks.views))
    assert found.kind == f"free{AND}{CARVED}"
    np.testing.assert_array_equal(pieces(found.mesh)[1].vertices, second.vertices)
    assert f"object 2, {CARVED}: no outline tells of 90 %" in found.decision.why


def test_pieces_are_counted_by_their_first_faces() -> None:
    one, two = sphere(0.2, 8), box((2, 0, 0), (3, 1, 1))
    mesh = joined([one, two])
    turned = replace(mesh, faces=mesh.faces[::-1])
    assert piece_labels(mesh).tolist() == [0] * len(one.faces) + [1] * len(two.faces)
    assert piece_labels(turned).tolist() == [0] * len(two.faces) + [1] * len(one.faces)
    for piece, whole in zip(pieces(mesh), (one, two), strict=True):
        np.testing.assert_array_equal(piece.vertices[piece.faces], whole.vertices[whole.faces])
    assert pieces(one)[0] is one
