"""PLY: exact round trip, the 3DGS layout, bad files, and another program that reads it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib import recfunctions
from surfel_cases import random_surfels

from rtgs.gaussians.ply import read_ply, write_ply
from rtgs.gaussians.surfels import Surfels


def assert_same_bits(a: Surfels, b: Surfels) -> None:
    for (name, x), (_, y) in zip(a.items(), b.items()):
        assert x.shape == y.shape, name
        assert torch.equal(x.detach().view(torch.int32), y.detach().view(torch.int32)), name


def read_vertices(path: Path) -> np.ndarray:
    return plyfile.PlyData.read(str(path))["vertex"].data.copy()


def rewrite(path: Path, change) -> None:
    """Write the file again with ``change`` applied to its vertex array."""
    vertices = change(read_vertices(path))
    plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")], text=False).write(str(path))


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "scene.ply"
    write_ply(path, random_surfels(7))
    return path


@pytest.mark.parametrize("third_scale", [True, False])
@pytest.mark.parametrize("coefficients", [0, 3, 8, 15])
@pytest.mark.parametrize("count", [0, 1, 20])
def test_round_trip(tmp_path, count, coefficients, third_scale):
    surfels = random_surfels(count, coefficients)
    write_ply(tmp_path / "a.ply", surfels, third_scale)
    assert_same_bits(surfels, read_ply(tmp_path / "a.ply"))
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


@settings(max_examples=30, deadline=None)
@given(data=st.data(), count=st.integers(0, 4), third_scale=st.booleans())
def test_round_trip_of_any_float32(tmp_path_factory, data, count, third_scale):
    number = st.floats(width=32, allow_nan=False, allow_infinity=False)
    surfels = random_surfels(count, 3)
    drawn = {
        name: torch.tensor(data.draw(st.lists(number, min_size=v.numel(), max_size=v.numel()))).reshape(v.shape)
        for name, v in surfels.items()
    }
    path = tmp_path_factory.mktemp("ply") / "any.ply"
    write_ply(path, Surfels(**drawn), third_scale)
    assert_same_bits(Surfels(**drawn), read_ply(path))


def test_layout_of_3dgs(tmp_path):
    surfels = random_surfels(3)
    write_ply(tmp_path / "a.ply", surfels)
    vertices = read_vertices(tmp_path / "a.ply")
    expected = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(45))]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert list(vertices.dtype.names) == expected
    assert {str(vertices.dtype[name]) for name in expected} == {"float32"}
    # f_rest_{c * 15 + k} is coefficient k of channel c
    assert vertices["f_rest_17"][1] == surfels.sh_rest[1, 2, 1].item()
    assert vertices["opacity"][2] == surfels.opacity_logits[2].item()
    assert vertices["scale_1"][0] == surfels.log_scales[0, 1].item()
    np.testing.assert_allclose(np.exp(vertices["scale_2"]), 1e-6, rtol=1e-5)
    normal = np.stack([vertices[name] for name in ("nx", "ny", "nz")], 1)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=1e-5)


def test_native_file_has_two_scales(tmp_path):
    write_ply(tmp_path / "a.ply", random_surfels(3), third_scale=False)
    names = read_vertices(tmp_path / "a.ply").dtype.names
    assert [name for name in names if name.startswith("scale")] == ["scale_0", "scale_1"]


def test_text_doubles_and_extra_properties_are_read(tmp_path, written):
    vertices = read_vertices(written)
    wide = [(name, "<f8") for name in vertices.dtype.names]
    other = np.zeros(len(vertices), dtype=[("roughness", "u1"), *reversed(wide)])
    for name in vertices.dtype.names:
        other[name] = vertices[name]
    path = tmp_path / "text.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(other, "vertex")], text=True).write(str(path))
    for (_, a), (_, b) in zip(random_surfels(7).items(), read_ply(path).items()):
        torch.testing.assert_close(a.detach(), b)


def test_write_refuses_nan_and_leaves_the_old_file(tmp_path, written):
    before = written.read_bytes()
    surfels = random_surfels(4)
    with torch.no_grad():
        surfels.sh_rest[2, 0, 0] = float("nan")
    with pytest.raises(ValueError, match="not written: 1 values of sh_rest are NaN or inf"):
        write_ply(written, surfels)
    assert written.read_bytes() == before


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone.ply: no such file"):
        read_ply(tmp_path / "gone.ply")


@pytest.mark.parametrize(
    "content",
    [b"", b"\x89PNG\r\n\x1a\n" + bytes(50), b"solid cube\n", b"ply\nformat nonsense\n"],
    ids=["empty", "png", "stl", "header"],
)
def test_not_a_ply(tmp_path, content):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.ply is not a PLY file"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("lost", [1, 100, 1000])
def test_truncated(written, lost):
    content = written.read_bytes()
    written.write_bytes(content[:-lost])
    with pytest.raises(ValueError, match="damaged or truncated"):
        read_ply(written)


@pytest.mark.parametrize("count", [b"6", b"8", b"99999999999999999", b"-3"])
def test_header_with_a_wrong_count(written, count):
    content = written.read_bytes()
    assert b"element vertex 7\n" in content
    written.write_bytes(content.replace(b"element vertex 7\n", b"element vertex " + count + b"\n"))
    with pytest.raises(ValueError, match=r"damaged|not a PLY"):
        read_ply(written)


@pytest.mark.parametrize("name", ["x", "opacity", "scale_1", "rot_3", "f_dc_0"])
def test_missing_property(written, name):
    rewrite(written, lambda v: recfunctions.drop_fields(v, name))
    with pytest.raises(ValueError, match=f"property {name} missing; it has "):
        read_ply(written)


def test_incomplete_harmonics(written):
    rewrite(written, lambda v: recfunctions.drop_fields(v, "f_rest_44"))
    with pytest.raises(ValueError, match=r"44 properties f_rest_\*"):
        read_ply(written)
    write_ply(written, random_surfels(7))
    rewrite(written, lambda v: recfunctions.rename_fields(v, {"f_rest_3": "f_rest_45"}))
    with pytest.raises(ValueError, match="f_rest_3 missing"):
        read_ply(written)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_in_the_file(written, bad):
    def spoil(vertices):
        vertices = vertices.copy()
        vertices["rot_1"][4] = bad
        return vertices

    rewrite(written, spoil)
    with pytest.raises(ValueError, match="NaN or inf in quaternions of 1 of 7 vertices, the first 4"):
        read_ply(written)


def test_thick_gaussians_are_refused(written):
    def thicken(vertices):
        vertices = vertices.copy()
        vertices["scale_2"][:3] = -4
        return vertices

    rewrite(written, thicken)
    with pytest.raises(ValueError, match="3 of 7 Gaussians have a third scale"):
        read_ply(written)


def test_no_vertices(tmp_path):
    faces = np.zeros(2, dtype=[("red", "u1")])
    plyfile.PlyData([plyfile.PlyElement.describe(faces, "face")]).write(str(tmp_path / "a.ply"))
    with pytest.raises(ValueError, match="no element 'vertex'; it has face"):
        read_ply(tmp_path / "a.ply")


def splat_transform() -> str:
    found = os.environ.get("RTGS_SPLAT_TRANSFORM") or shutil.which("splat-transform")
    if not found:
        pytest.skip(
            "splat-transform not found: npm install -g @playcanvas/splat-transform, or set RTGS_SPLAT_TRANSFORM"
        )
    return found


@pytest.mark.parametrize("coefficients", [0, 3, 8, 15])
def test_splat_transform_reads_it(tmp_path, coefficients):
    program = splat_transform()
    surfels = random_surfels(200, coefficients)
    write_ply(tmp_path / "in.ply", surfels)
    command = [program, "--overwrite", str(tmp_path / "in.ply"), "--filter-nan", str(tmp_path / "out.ply")]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    vertices = read_vertices(tmp_path / "out.ply")
    original = read_vertices(tmp_path / "in.ply")
    assert len(vertices) == 200
    for name in set(original.dtype.names) - {"nx", "ny", "nz"}:
        np.testing.assert_array_equal(vertices[name], original[name], err_msg=name)
    assert_same_bits(read_ply(tmp_path / "out.ply"), surfels)
