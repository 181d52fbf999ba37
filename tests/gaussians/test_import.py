"""Splats of other tools: any order of properties, text, packed, real files, and what is said of broken ones."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib import recfunctions
from surfel_cases import random_surfels

from rtgs.core.errors import RtgsError
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.harmonics import sh_dc_to_rgb
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.gaussians.surfels import Surfels

SPLATS = Path(os.environ.get("RTGS_SHARED", Path(__file__).resolve().parents[3] / "shared")) / "data" / "splats"
REQUIRED = {
    "x",
    "y",
    "z",
    "opacity",
    *(f"{p}_{k}" for p, n in (("scale", 2), ("rot", 4), ("f_dc", 3)) for k in range(n)),
}


def ellipsoids(count: int = 6, coefficients: int = 15) -> Ellipsoids:
    found = random_surfels(count, coefficients, kind=Ellipsoids).detached()
    assert isinstance(found, Ellipsoids)
    return found


def vertices_of(path: Path) -> np.ndarray:
    return plyfile.PlyData.read(str(path))["vertex"].data.copy()


def write_vertices(path: Path, vertices: np.ndarray, **form) -> None:
    plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")], **form).write(str(path))


def assert_same(a, b, tolerance: float = 0.0) -> None:
    assert type(a) is type(b)
    for (name, x), (_, y) in zip(a.items(), b.items()):
        torch.testing.assert_close(x, y, rtol=tolerance, atol=tolerance, msg=lambda m, name=name: f"{name}: {m}")


@pytest.mark.parametrize("coefficients", [0, 3, 8, 15])
def test_ellipsoids_go_round_bit_for_bit(tmp_path, coefficients: int):
    written = ellipsoids(20, coefficients)
    write_ply(tmp_path / "a.ply", written)
    assert_same(read_gaussians(tmp_path / "a.ply"), written)
    vertices = vertices_of(tmp_path / "a.ply")
    assert vertices.dtype.names is not None
    assert list(vertices.dtype.names[:9]) == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert vertices.dtype.names[-8:] == ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    assert not vertices["nx"].any()


@settings(max_examples=40, deadline=None)
@given(
    data=st.data(),
    coefficients=st.sampled_from([0, 3, 8, 15]),
    text=st.booleans(),
    order=st.sampled_from("<>"),
    wide=st.booleans(),
)
def test_any_order_form_and_company(tmp_path_factory, data, coefficients, text, order, wide):
    path = tmp_path_factory.mktemp("odd") / "a.ply"
    written = ellipsoids(3, coefficients)
    write_ply(path, written)
    plain = vertices_of(path)
    extra = data.draw(st.lists(st.sampled_from(["label", "red", "f_extra", "time", "_"]), unique=True))
    names = data.draw(st.permutations([*(n for n in plain.dtype.names or () if n[0] != "n"), *extra]))
    kind = "f8" if wide else "f4"
    odd = np.zeros(3, dtype=[(name, "u1" if name in extra else kind) for name in names])
    for name in set(names) - set(extra):
        odd[name] = plain[name]
    write_vertices(path, odd, text=text, byte_order="=" if text else order)
    assert_same(read_gaussians(path), written, 1e-6 if text else 0.0)


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_what_is_missing_is_named(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("odd") / "a.ply"
    write_ply(path, ellipsoids(2, 0))
    plain = vertices_of(path)
    gone = data.draw(st.sampled_from(sorted(REQUIRED)))
    write_vertices(path, recfunctions.drop_fields(plain, gone))
    with pytest.raises(RtgsError, match=rf"property {gone}.* missing; it has x|property .*{gone} missing; it has"):
        read_gaussians(path)


@settings(max_examples=40, deadline=None)
@given(cut=st.floats(0, 0.999))
def test_truncated_files_are_told_from_sound_ones(tmp_path_factory, cut: float):
    path = tmp_path_factory.mktemp("odd") / "a.ply"
    write_ply(path, ellipsoids(3, 3))
    content = path.read_bytes()
    path.write_bytes(content[: int(cut * len(content))])
    with pytest.raises(RtgsError, match=r"is not a PLY file|is damaged or truncated"):
        read_gaussians(path)


def test_flat_ones_are_surfels(tmp_path):
    write_ply(tmp_path / "a.ply", random_surfels(5))
    assert type(read_gaussians(tmp_path / "a.ply")) is Surfels
    write_ply(tmp_path / "a.ply", random_surfels(5), third_scale=False)
    assert type(read_gaussians(tmp_path / "a.ply")) is Surfels


def test_a_plain_point_cloud_is_called_one(tmp_path):
    write_vertices(tmp_path / "a.ply", np.zeros(2, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1")]))
    with pytest.raises(RtgsError, match="f_dc_2 missing; it has x, y, z, red; a plain point cloud holds no Gaussians"):
        read_gaussians(tmp_path / "a.ply")


def test_colours_in_bytes_instead_of_harmonics(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, ellipsoids(4, 0))
    plain = vertices_of(path)
    names = [name for name in plain.dtype.names or () if not name.startswith("f_dc")]
    colored = np.zeros(4, dtype=[*((name, "f4") for name in names), *((c, "u1") for c in ("red", "green", "blue"))])
    for name in names:
        colored[name] = plain[name]
    colored["green"] = 51
    write_vertices(path, colored)
    torch.testing.assert_close(sh_dc_to_rgb(read_gaussians(path).sh_dc), torch.tensor([[0.0, 0.2, 0.0]]).expand(4, 3))


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_broken_ones_are_named_or_left_out(tmp_path, bad: float):
    path = tmp_path / "a.ply"
    whole = ellipsoids()
    write_ply(path, whole)
    vertices = vertices_of(path)
    vertices["opacity"][2] = bad
    vertices["f_rest_7"][5] = bad
    write_vertices(path, vertices)
    with pytest.raises(
        RtgsError, match=r"NaN or inf in opacity_logits, sh_rest of 2 of 6 vertices, the first 2; .*skip"
    ):
        read_gaussians(path)
    kept = read_gaussians(path, skip_broken=True)
    assert torch.equal(kept.means, whole.means[[0, 1, 3, 4]])


def packed_file(path: Path) -> None:
    """A compressed splat of two Gaussians in one chunk (layout of PlayCanvas)."""
    names = [f"{edge}_{axis}" for edge in ("min", "max") for axis in "xyz"]
    names += [f"{edge}_scale_{axis}" for edge in ("min", "max") for axis in "xyz"]
    names += [f"{edge}_{axis}" for edge in ("min", "max") for axis in "rgb"]
    chunk = np.zeros(1, dtype=[(name, "f4") for name in names])
    for name in names:
        chunk[name] = 1.0 if name.startswith("max") else -1.0
    vertex = np.zeros(2, dtype=[(f"packed_{what}", "u4") for what in ("position", "rotation", "scale", "color")])
    vertex["packed_position"][1] = 0xFFFFFFFF
    vertex["packed_rotation"] = 512 << 20 | 512 << 10 | 512
    vertex["packed_color"] = 0x80808080
    elements = [plyfile.PlyElement.describe(chunk, "chunk"), plyfile.PlyElement.describe(vertex, "vertex")]
    plyfile.PlyData(elements, byte_order="<").write(str(path))


def test_packed_splats_are_unpacked(tmp_path):
    pytest.importorskip("gsply", reason="pip install -e '.[compressed]'")
    packed_file(tmp_path / "a.compressed.ply")
    found = read_gaussians(tmp_path / "a.compressed.ply")
    assert type(found) is Ellipsoids
    torch.testing.assert_close(found.means, torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    torch.testing.assert_close(found.log_scales, torch.full((2, 3), -1.0))
    torch.testing.assert_close(found.opacity_logits, torch.full((2,), float(np.log(128 / 127))), atol=1e-5, rtol=0)


def test_without_its_reader_packed_splats_are_refused_with_the_way_out(tmp_path, monkeypatch):
    packed_file(tmp_path / "a.compressed.ply")
    monkeypatch.setitem(sys.modules, "gsply", None)
    with pytest.raises(
        RtgsError, match=r"pip install -e '.\[compressed\]'.*`splat-transform in\.compressed\.ply out\.ply`"
    ):
        read_gaussians(tmp_path / "a.compressed.ply")


def test_a_packed_file_cut_short_is_refused(tmp_path):
    path = tmp_path / "a.compressed.ply"
    packed_file(path)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(RtgsError, match="is damaged or truncated"):
        read_gaussians(path)


def real(name: str) -> Path:
    if not (SPLATS / name).is_file():
        pytest.skip(f"{name} is not there: set RTGS_SHARED to the folder that holds data/splats")
    return SPLATS / name


def test_a_real_file_and_its_compressed_original_agree():
    plain = read_gaussians(real("guitar.ply"))
    assert (len(plain), plain.sh_degree, type(plain)) == (90_854, 0, Ellipsoids)
    pytest.importorskip("gsply", reason="pip install -e '.[compressed]'")
    packed = read_gaussians(real("guitar.compressed.ply"))
    opaque = packed.opacity_logits > 6  # 255 of 255 has no logit: each decoder takes its own large one
    for (name, a), (_, b) in zip(plain.items(), packed.items()):
        if name == "opacity_logits":
            a, b = a[~opaque], b[~opaque]
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5, msg=lambda m, name=name: f"{name}: {m}")


def test_a_real_file_with_all_harmonics_goes_round(tmp_path):
    found = read_gaussians(real("playbot_lod2.ply"))
    assert (len(found), found.sh_degree, type(found)) == (125_000, 3, Ellipsoids)
    write_ply(tmp_path / "a.ply", found)
    assert_same(read_gaussians(tmp_path / "a.ply"), found)
