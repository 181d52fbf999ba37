"""PlayCanvas' compressed PLY."""

from __future__ import annotations

import plyfile
import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.export.compressed_ply import read_compressed_ply, write_compressed_ply
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.primitives import unit_or_zero
from rtgs.gaussians.surfels import Surfels
from rtgs.render.orbit import Orbit, Picture, orbit_cameras
from rtgs.render.splats import render_splats
from rtgs.train.held_out import psnr_of
from tests.export.test_bake import some


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
@pytest.mark.parametrize(("count", "degree"), [(1, 0), (256, 1), (300, 2), (700, 3)])
def test_splats_of_several_chunks_come_back_within_their_steps(kind, count, degree, tmp_path):
    splats = some(kind, count, degree)
    write_compressed_ply(tmp_path / "a.ply", splats)
    found = read_compressed_ply(tmp_path / "a.ply")
    assert type(found) is kind
    assert (len(found), found.sh_degree) == (count, degree)
    nearest = torch.cdist(splats.means, found.means).argmin(1)
    assert len(nearest.unique()) > 0.98 * count
    found = found.like({name: values[nearest] for name, values in found.items()})
    torch.testing.assert_close(found.means, splats.means, atol=3e-3, rtol=0)
    close = (found.log_scales - splats.log_scales).abs().amax(1) < 3e-3
    assert close.float().mean() > 0.95  # two at one place may be taken for each other
    assert ((found.sh_rest - splats.sh_rest).abs().flatten(1) <= 1 / 32 + 1e-6)[close].all()
    turned = (found.quaternions * unit_or_zero(splats.quaternions)).sum(1).abs()
    assert (turned[close] > 1 - 1e-5).all()


def test_the_picture_stays(tmp_path):
    splats = some(Surfels, 400, 3)
    write_compressed_ply(tmp_path / "a.ply", splats)
    assert "SplatRenderMode: 2dgs" in plyfile.PlyData.read(str(tmp_path / "a.ply")).comments
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    for camera in orbit_cameras(Orbit(torch.zeros(3, dtype=torch.float64), 3.0, up), Picture(48, 36, 40.0), 3):
        found = render_splats(read_compressed_ply(tmp_path / "a.ply"), camera)
        assert psnr_of(found, render_splats(splats, camera).clamp(0, 1)) > 32


def test_ends_of_the_ranges(tmp_path):
    splats = some(Ellipsoids, 3)
    splats.opacity_logits = torch.tensor([90.0, -90, 0])
    splats.quaternions[:] = 0
    splats.means[:] = 7
    splats.log_scales[0] = 50
    write_compressed_ply(tmp_path / "a.ply", splats)
    found = read_compressed_ply(tmp_path / "a.ply")
    assert (found.means == 7).all()
    assert found.log_scales.max() == 20
    assert torch.allclose(found.quaternions.abs(), torch.tensor([1.0, 0, 0, 0]), atol=1e-3)
    with pytest.raises(RtgsError, match="there is no Gaussian"):
        write_compressed_ply(tmp_path / "b.ply", some(Ellipsoids, 0))


def test_damaged_compressed_files_are_refused_by_name(tmp_path):
    write_compressed_ply(tmp_path / "a.ply", some(Surfels, 300, 1))
    data = (tmp_path / "a.ply").read_bytes()
    cases = {
        "cut": data[:-3],
        "empty": b"",
        "chunks": data.replace(b"element chunk 2", b"element chunk 1"),
        "name": data.replace(b"packed_scale", b"packed_skale"),
        "kind": data.replace(b"element sh ", b"element hs "),
    }
    for name, content in cases.items():
        (tmp_path / f"{name}.ply").write_bytes(content)
        if name == "kind":  # without SH of higher degrees
            assert read_compressed_ply(tmp_path / "kind.ply").sh_degree == 0
            continue
        with pytest.raises(RtgsError, match=rf"{name}\.ply is no compressed PLY"):
            read_compressed_ply(tmp_path / f"{name}.ply")
