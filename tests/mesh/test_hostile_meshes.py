"""Mesh files that are none: refused in words that name the file."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from rtgs.core.errors import RtgsError
from rtgs.mesh.triangles import TriangleMesh, read_mesh_obj, read_mesh_ply, write_mesh_ply

VERTEX = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = "property list uchar int vertex_indices\n"


def ply(header: str, body: bytes, form: str = "binary_little_endian") -> bytes:
    return f"ply\nformat {form} 1.0\n{header}end_header\n".encode() + body


CORNERS = np.eye(3, dtype="<f4").tobytes()
TRIANGLE = struct.pack("<B3i", 3, 0, 1, 2)
BAD = {
    "no faces": (ply(f"{VERTEX}element face 0\n{FACE}", CORNERS), "holds no faces"),
    "forged vertices": (ply(f"{VERTEX.replace('3', '999999999999')}element face 1\n{FACE}", CORNERS), "it announces"),
    "forged faces": (ply(f"{VERTEX}element face 999999999999\n{FACE}", CORNERS + TRIANGLE), "it announces"),
    "forged corners": (
        ply(f"{VERTEX}element face 1\nproperty list uint int vertex_indices\n", CORNERS + struct.pack("<I", 2**32 - 1)),
        "not a readable PLY",
    ),
    "corners beyond": (ply(f"{VERTEX}element face 1\n{FACE}", CORNERS + struct.pack("<B3i", 3, 0, 1, 3)), "point to"),
    "corners as floats": (
        ply(f"{VERTEX}element face 1\n{FACE.replace(' int', ' float')}", CORNERS + struct.pack("<B3f", 3, 0, 1, 2)),
        "no whole numbers",
    ),
    "squares": (ply(f"{VERTEX}element face 1\n{FACE}", CORNERS + struct.pack("<B4i", 4, 0, 1, 2, 0)), "three corners"),
    "lists as places": (
        ply(f"{VERTEX.replace('float x', 'list uchar float x')}element face 1\n{FACE}", bytes(60)),
        "not a (usable mesh|readable PLY)",
    ),
    "not a number": (
        ply(f"{VERTEX}element face 1\n{FACE}", np.full(9, np.nan, "<f4").tobytes() + TRIANGLE),
        "NaN or inf",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_ply(tmp_path, name):
    content, message = BAD[name]
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(RtgsError, match=f"a.ply.*{message}"):
        read_mesh_ply(tmp_path / "a.ply")


def test_a_sound_mesh_is_read_with_its_colours(tmp_path):
    mesh = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]), np.array([[0.0, 0.2, 1.0]] * 3))
    write_mesh_ply(tmp_path / "a.ply", mesh)
    stored = read_mesh_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(stored.vertices, mesh.vertices)
    np.testing.assert_array_equal(stored.faces, mesh.faces)
    np.testing.assert_allclose(stored.colors, mesh.colors, atol=1e-6)


@pytest.mark.parametrize("line", ["f 1 2 99999999999999999999", "f 1 2 x", "v 1 2", "v nan 0 0", "f 1 0 2", "f 1 2 -9"])
def test_damaged_obj(tmp_path, line):
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n{line}\n")
    with pytest.raises(RtgsError, match=r"a.obj is not a readable OBJ"):
        read_mesh_obj(tmp_path / "a.obj")
