"""Parts of a mesh between creases."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from rtgs.mesh.lathe import Axis, lathe
from rtgs.mesh.panels import parts_between_creases
from rtgs.mesh.polyhedron import Polyhedron
from rtgs.mesh.triangles import TriangleMesh

VOXEL = 0.02
AXIS = Axis.along(np.array([0.2, -0.1, 0.5]), np.array([0.1, 0.2, 1.0]))


def turned(*corners: tuple[float, float]) -> TriangleMesh:
    """A profile through these corners (radius, height), a vertex every half voxel."""
    nodes = [np.array(corners[:1])]
    for start, end in itertools.pairwise(corners):
        a, b = np.array(start), np.array(end)
        count = max(round(float(np.linalg.norm(b - a)) / (0.5 * VOXEL)), 1)
        nodes.append(a + (b - a) * (np.arange(count) + 1)[:, None] / count)
    return lathe(np.concatenate(nodes), AXIS)


def shares(mesh: TriangleMesh) -> list[float]:
    area = np.linalg.norm(mesh.face_normals(), axis=1)
    parts = parts_between_creases(mesh, VOXEL)
    assert sum(part.astype(int) for part in parts).max() == 1, "no face is in two parts"
    return [float(area[part].sum() / area.sum()) for part in parts]


def test_a_cylinder_has_a_side_a_bottom_and_a_lid():
    side, *ends = shares(turned((0, -0.5), (0.4, -0.5), (0.4, 0.5), (0, 0.5)))
    whole = 2 * np.pi * 0.4 * (1.0 + 0.4)
    assert side == pytest.approx(2 * np.pi * 0.4 / whole, abs=0.06)
    assert ends == pytest.approx([np.pi * 0.4**2 / whole] * 2, abs=0.03)
    assert all(share < np.pi * 0.4**2 / whole for share in ends), "faces on the crease are in none"


def test_a_roof_is_a_part_as_a_lid_is():
    parts = shares(turned((0, -0.5), (0.4, -0.5), (0.4, 0.5), (0, 0.62)))
    assert len(parts) == 3


def test_what_bends_smoothly_is_one_part():
    polar = np.linspace(0, np.pi, 90)
    assert shares(lathe(0.5 * np.stack([np.sin(polar), -np.cos(polar)], axis=1), AXIS)) == [pytest.approx(1.0)]


def test_a_box_has_six_sides_and_small_parts_are_none():
    size = np.array([0.5, 0.4, 0.3])
    normals, offsets = np.concatenate([np.eye(3), -np.eye(3)]), np.concatenate([size, size])
    box = Polyhedron.of(normals, offsets, np.zeros(3))
    assert box is not None
    parts = shares(box.mesh(VOXEL))
    assert len(parts) == 6
    assert parts == sorted(parts, reverse=True)
    assert len(shares(turned((0, -0.5), (0.4, -0.5), (0.4, 0.5), (0.06, 0.5), (0.06, 0.54), (0, 0.54)))) == 3
