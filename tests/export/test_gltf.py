"""GLB files of Gaussians with glass."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.export.glass import GlassObject
from rtgs.export.gltf import GLASS, SPLATS, read_glb, write_glb
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.primitives import unit_or_zero
from rtgs.gaussians.surfels import Surfels
from rtgs.light.pictures import upright
from rtgs.render.orbit import Orbit, Picture, orbit_cameras
from rtgs.render.splats import render_splats
from tests.export.test_bake import some

TRIANGLES = GlassObject(
    np.eye(3, dtype=np.float32), np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]), 1.47, (0.9, 1.0, 0.8), 0.1
)


def document(path):
    data = path.read_bytes()
    return json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_gaussians_come_back_and_look_the_same(kind, degree, tmp_path):
    splats = some(kind, 30, degree)
    write_glb(tmp_path / "a.glb", splats)
    found = read_glb(tmp_path / "a.glb")
    assert type(found.splats) is kind
    for name in ("means", "sh_dc", "sh_rest"):
        assert torch.equal(found.splats[name], splats[name])
    torch.testing.assert_close(found.splats.log_scales, splats.log_scales)
    torch.testing.assert_close(found.splats.opacity_logits.sigmoid(), splats.opacity_logits.sigmoid())
    torch.testing.assert_close(found.splats.quaternions, unit_or_zero(splats.quaternions))
    assert not len(found.faces)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    camera = orbit_cameras(Orbit(torch.zeros(3, dtype=torch.float64), 3.0, up), Picture(32, 24, 40.0), 1)[0]
    torch.testing.assert_close(render_splats(found.splats, camera), render_splats(splats, camera), atol=1e-4, rtol=0)


def test_values_are_activated_and_y_is_up(tmp_path):
    splats = some(Ellipsoids, 5)
    frame = upright(np.array([0.0, -1.0, 0.2]), np.array([0.0, 0.0, 1.0]))
    write_glb(tmp_path / "a.glb", splats, frame)
    found = document(tmp_path / "a.glb")
    primitive = found["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"][SPLATS]["kernel"] == "ellipse"
    assert found["extensionsUsed"] == [SPLATS]
    view = found["bufferViews"][found["accessors"][primitive["attributes"][f"{SPLATS}:SCALE"]]["bufferView"]]
    data = (tmp_path / "a.glb").read_bytes()
    start = 28 + struct.unpack_from("<I", data, 12)[0] + view["byteOffset"]
    scales = np.frombuffer(data, "<f4", 15, start).reshape(5, 3)
    np.testing.assert_allclose(scales, splats.log_scales.exp().numpy(), rtol=1e-6)
    turn = read_glb(tmp_path / "a.glb").turn
    np.testing.assert_allclose(turn, frame, atol=1e-7)
    np.testing.assert_allclose(turn @ (np.array([0.0, -1.0, 0.2]) / np.hypot(1, 0.2)), [0, 1, 0], atol=1e-7)


def test_glass_is_a_mesh_that_lets_light_pass(tmp_path):
    write_glb(tmp_path / "a.glb", some(Surfels, 5), glass=TRIANGLES)
    found = document(tmp_path / "a.glb")
    (material,) = found["materials"]
    assert found["extensionsUsed"] == [SPLATS, *GLASS]
    assert material["extensions"]["KHR_materials_transmission"] == {"transmissionFactor": 1.0}
    assert material["extensions"]["KHR_materials_ior"] == {"ior": 1.47}
    assert material["pbrMetallicRoughness"]["baseColorFactor"] == [0.9, 1.0, 0.8, 1.0]
    assert found["nodes"][0]["children"] == [1, 2]
    back = read_glb(tmp_path / "a.glb")
    assert (back.vertices == TRIANGLES.vertices).all()
    assert (back.faces == TRIANGLES.faces).all()


def test_the_ends_of_the_ranges(tmp_path):
    splats = some(Ellipsoids, 3)
    splats.opacity_logits = torch.tensor([40.0, -40.0, 0.0])
    splats.quaternions[0] = 0
    splats.log_scales[1] = -60
    write_glb(tmp_path / "a.glb", splats)
    found = read_glb(tmp_path / "a.glb").splats
    assert found.opacity_logits.sigmoid().tolist() == [1.0, pytest.approx(0, abs=1e-12), 0.5]
    assert found.quaternions[0].tolist() == [1, 0, 0, 0]
    assert torch.isfinite(found.log_scales).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("meshes"), "it lacks 'meshes'"),
        (lambda d: d["accessors"][0].update(count=7), "reaches over the end"),
        (lambda d: d["accessors"][0].update(count=-1), "no whole number"),
        (lambda d: d["accessors"][3].update(count=2), "has 2 rows, there are 5 positions"),
        (lambda d: d["accessors"][0].update(componentType=5123), "is VEC3 of type 5123"),
        (lambda d: d["bufferViews"][0].update(byteOffset=10**9), "reaches over the end"),
        (lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 2]), "no unit quaternion"),
        (lambda d: d["meshes"][0]["primitives"][0].pop("extensions"), "no primitive has KHR"),
        (lambda d: d.update(meshes=3), "not iterable"),
    ],
)
def test_damaged_documents_are_refused_by_name(change, message, tmp_path):
    write_glb(tmp_path / "a.glb", some(Surfels, 5, 1))
    data = (tmp_path / "a.glb").read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    found = json.loads(data[20 : 20 + length])
    change(found)
    text = json.dumps(found).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    header = struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    (tmp_path / "b.glb").write_bytes(header + text + rest)
    with pytest.raises(RtgsError, match=message) as error:
        read_glb(tmp_path / "b.glb")
    assert "b.glb" in str(error.value)


def test_a_file_that_is_cut_or_gone(tmp_path):
    write_glb(tmp_path / "a.glb", some(Surfels, 5))
    data = (tmp_path / "a.glb").read_bytes()
    for length in (0, 11, 30, len(data) - 4):
        (tmp_path / "b.glb").write_bytes(data[:length])
        with pytest.raises(RtgsError, match=r"b\.glb is no GLB"):
            read_glb(tmp_path / "b.glb")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_glb(tmp_path / "gone.glb")
