"""A triangle mesh and its files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rtgs.core.errors import RtgsError
from rtgs.core.ply_header import check_ply

if TYPE_CHECKING:
    from plyfile import PlyData, PlyElement


@dataclass(frozen=True)
class TriangleMesh:
    """V vertices, F triangles, world frame; counter-clockwise seen from outside."""

    vertices: np.ndarray  # (V, 3) float32
    faces: np.ndarray  # (F, 3) int32
    colors: np.ndarray | None = None  # (V, 3) float32 in [0, 1]

    def __post_init__(self) -> None:
        with np.errstate(over="ignore"):  # beyond float32: inf, which is refused
            vertices, faces = np.asarray(self.vertices, np.float32), np.asarray(self.faces, np.int32)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,):
            raise ValueError(f"mesh takes vertices (V, 3) and faces (F, 3), got {vertices.shape} and {faces.shape}")
        if not np.isfinite(vertices).all():
            raise ValueError("mesh vertices hold NaN or inf")
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError(f"mesh faces point to vertices {faces.min()} to {faces.max()}, there are {len(vertices)}")
        if self.colors is not None and np.shape(self.colors) != vertices.shape:
            raise ValueError(f"mesh colours have shape {np.shape(self.colors)}, expected {vertices.shape}")
        object.__setattr__(self, "vertices", np.ascontiguousarray(vertices))
        object.__setattr__(self, "faces", np.ascontiguousarray(faces))

    def face_normals(self) -> np.ndarray:
        """(F, 3) float64 outward normals, twice the area long."""
        a, b, c = (self.vertices[self.faces[:, k]].astype(np.float64) for k in range(3))
        return np.cross(b - a, c - a)


def edges_of(faces: np.ndarray, count: int) -> np.ndarray:
    """(E, 2) the edges of faces (F, 3) between ``count`` vertices, each once, ascending; the lower vertex first."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    keys = np.sort(ends.min(1) * count + ends.max(1))
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack(np.divmod(keys, max(count, 1)), axis=1)


def in_order(mesh: TriangleMesh) -> TriangleMesh:
    """The same surface with faces by where their corners are, the first corner first, and vertices as faces name them.
    Two meshes that differ in nothing but numbers become one, to the bit, unless two faces have the same three points.
    Vertices of no face go."""
    order = np.lexsort(mesh.vertices.T[::-1])
    place = np.zeros(len(order), np.int64)  # among all points; of vertices at one point the same
    place[order[1:]] = (np.diff(mesh.vertices[order], axis=0) != 0).any(1).cumsum()
    turned = (place[mesh.faces].argmin(1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(mesh.faces, turned, 1)
    faces = faces[np.lexsort(place[faces].T[::-1])]
    used, first = np.unique(faces, return_index=True)
    used = used[first.argsort()]
    number = np.zeros(len(order), np.int32)
    number[used] = np.arange(len(used))
    return TriangleMesh(mesh.vertices[used], number[faces], None if mesh.colors is None else mesh.colors[used])


def write_mesh_ply(path: Path, mesh: TriangleMesh) -> None:
    """Binary PLY with vertices, 8-bit colours if there are any, and triangles."""
    from plyfile import PlyData, PlyElement

    fields = [("x", "f4"), ("y", "f4"), ("z", "f4")]
    if mesh.colors is not None:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.empty(len(mesh.vertices), dtype=fields)
    for k, name in enumerate("xyz"):
        vertices[name] = mesh.vertices[:, k]
    if mesh.colors is not None:
        for k, name in enumerate(("red", "green", "blue")):
            vertices[name] = np.rint(np.clip(mesh.colors[:, k], 0, 1) * 255)
    faces = np.empty(len(mesh.faces), dtype=[("vertex_indices", "i4", (3,))])
    described = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    rows = np.empty(len(mesh.faces), dtype=[("corners", "u1"), ("vertex_indices", "<i4", (3,))])
    rows["corners"], rows["vertex_indices"] = 3, mesh.faces
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:  # plyfile writes lists one by one, which takes 100 times as long
        stream.write(PlyData(described, byte_order="<").header.encode("ascii") + b"\n")
        stream.write(vertices.astype(vertices.dtype.newbyteorder("<")).tobytes() + rows.tobytes())


def read_mesh_ply(path: Path) -> TriangleMesh:
    """A triangle mesh from a PLY file.

    Raises:
        RtgsError: not a readable PLY, no faces (a point cloud), faces that are not triangles or point to no vertex,
            vertices without x y z, or that are not finite.
    """
    from plyfile import PlyParseError

    try:
        check_ply(path)
        with np.errstate(over="ignore"):  # numbers in text beyond their type become inf, which is refused
            data = _read_ply(path)
    except (PlyParseError, OSError, ValueError, MemoryError, OverflowError) as error:
        raise RtgsError(f"{path} is not a readable PLY: {error}") from error
    names = {element.name for element in data.elements}
    if "vertex" not in names or "face" not in names:
        raise RtgsError(f"{path} has elements {sorted(names)}, a mesh needs vertex and face; is it a point cloud?")
    vertex, face = data["vertex"], data["face"]
    if not {"x", "y", "z"} <= {item.name for item in vertex.properties}:
        raise RtgsError(f"{path} has vertices without x y z; export it again")
    if not face.count:
        raise RtgsError(f"{path} holds no faces; is it a point cloud?")
    try:
        vertices, colors = _columns(vertex, ("x", "y", "z")), None
        if {"red", "green", "blue"} <= {item.name for item in vertex.properties}:
            colors = _columns(vertex, ("red", "green", "blue")) / np.float32(255)
        return TriangleMesh(vertices, _triangles(path, face), colors)
    except RtgsError:
        raise
    except (ValueError, TypeError, OverflowError) as error:
        raise RtgsError(f"{path} is not a usable mesh: {error}") from error


def _columns(element: PlyElement, names: tuple[str, ...]) -> np.ndarray:
    """(N, 3) float32; a property that is a list is refused."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond float32 becomes inf, which the mesh refuses
        return np.stack([np.asarray(element[name]).astype(np.float32) for name in names], axis=1)


def _triangles(path: Path, face: PlyElement) -> np.ndarray:
    """(F, 3) int32 corners of the first property of the faces."""
    rows = list(face[face.properties[0].name])
    if any(np.shape(row) != (3,) for row in rows):
        raise RtgsError(f"{path} holds faces with other than three corners; triangulate it first")
    corners = np.array(rows).reshape(-1, 3)
    if not np.issubdtype(corners.dtype, np.integer):
        raise RtgsError(f"{path} holds corners of faces that are no whole numbers; export it again")
    return np.clip(corners, -1, np.iinfo(np.int32).max).astype(np.int32)  # beyond: no vertex, which the mesh refuses


def _read_ply(path: Path) -> PlyData:
    """Faces as one array where all have three corners, as in our own files; one by one they take 30 times as long."""
    from plyfile import PlyData, PlyElementParseError

    try:
        return PlyData.read(str(path), known_list_len={"face": {"vertex_indices": 3}})
    except PlyElementParseError:  # other faces, or a broken file: then this says what is wrong
        return PlyData.read(str(path))


def write_mesh_obj(path: Path, mesh: TriangleMesh) -> None:
    """Wavefront OBJ; colours follow the coordinates, as most viewers read them."""
    columns = mesh.vertices if mesh.colors is None else np.concatenate([mesh.vertices, mesh.colors], axis=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="ascii") as stream:
        np.savetxt(stream, columns, fmt="v" + " %.7g" * columns.shape[1])
        np.savetxt(stream, mesh.faces + 1, fmt="f %d %d %d")


def read_mesh_obj(path: Path) -> TriangleMesh:
    """Vertices and faces of a Wavefront OBJ; polygons become fans, everything else is ignored.

    Raises:
        RtgsError: no readable OBJ, or no faces.
    """
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    try:
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            words = line.split()
            if words[:1] == ["v"]:
                if len(words) < 4:
                    raise ValueError(f"{line!r}: a vertex has three coordinates")
                vertices.append([float(word) for word in words[1:4]])
            elif words[:1] == ["f"]:
                numbers = [int(word.split("/")[0]) for word in words[1:]]
                if 0 in numbers:
                    raise ValueError(f"{line!r}: vertices are counted from 1")
                corner = [number - 1 if number > 0 else len(vertices) + number for number in numbers]
                faces += [(corner[0], corner[k], corner[k + 1]) for k in range(1, len(corner) - 1)]
        mesh = TriangleMesh(np.array(vertices).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3))
    except (OSError, ValueError, IndexError, OverflowError) as error:
        raise RtgsError(f"{path} is not a readable OBJ: {str(error)[:200]}") from error
    if len(mesh.faces) == 0:
        raise RtgsError(f"{path} holds no faces; is it a point cloud?")
    return mesh
