"""SPZ files."""

from __future__ import annotations

import gzip
import struct

import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.export.spz import read_spz, write_spz
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.primitives import unit_or_zero
from rtgs.gaussians.surfels import Surfels
from rtgs.render.orbit import Orbit, Picture, orbit_cameras
from rtgs.render.splats import render_splats
from rtgs.train.held_out import psnr_of
from tests.export.test_bake import some


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splats_come_back_within_their_steps(kind, degree, tmp_path):
    splats = some(kind, 60, degree)
    write_spz(tmp_path / "a.spz", splats)
    found = read_spz(tmp_path / "a.spz")
    assert type(found) is kind
    assert found.sh_degree == degree
    torch.testing.assert_close(found.means, splats.means, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.log_scales, splats.log_scales, atol=1 / 32 + 1e-6, rtol=0)
    torch.testing.assert_close(found.sh_rest, splats.sh_rest, atol=1 / 256 + 1e-6, rtol=0)
    torch.testing.assert_close(found.opacity_logits.sigmoid(), splats.opacity_logits.sigmoid(), atol=1 / 509, rtol=0)
    assert ((found.quaternions * unit_or_zero(splats.quaternions)).sum(1).abs() > 1 - 1e-5).all()


def test_the_picture_stays(tmp_path):
    splats = some(Surfels, 80, 3)
    splats.sh_dc = splats.sh_dc.clamp(-1.5, 1.5)
    write_spz(tmp_path / "a.spz", splats)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    for camera in orbit_cameras(Orbit(torch.zeros(3, dtype=torch.float64), 3.0, up), Picture(48, 36, 40.0), 3):
        assert (
            psnr_of(render_splats(read_spz(tmp_path / "a.spz"), camera), render_splats(splats, camera).clamp(0, 1)) > 38
        )


def test_axes_are_right_up_backward(tmp_path):
    """As Niantic's library has them: y and z of a capture change their signs, and colours turn with them."""
    splats = some(Ellipsoids, 1, 1)
    splats.means = torch.tensor([[1.0, 2.0, 3.0]])
    splats.sh_rest = torch.tensor([[[0.5, 0, 0], [0.25, 0, 0], [0.125, 0, 0]]])  # of -y, z and -x
    write_spz(tmp_path / "a.spz", splats)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert struct.unpack_from("<IIIBBBB", data) == (0x5053474E, 3, 1, 1, 20, 0, 0)
    places = [int.from_bytes(data[16 + 3 * k : 19 + 3 * k], "little", signed=True) / 2**20 for k in range(3)]
    assert places == [1, -2, -3]
    assert list(data[36::3]) == [64, 96, 144]


def test_ends_of_the_ranges(tmp_path):
    splats = some(Ellipsoids, 4)
    splats.means = torch.tensor([[4e6, 0, 0], [0, -8e6, 0], [1.0, 1, 1], [0, 0, 0]])
    splats.opacity_logits = torch.tensor([50.0, -50.0, 0, 0])
    splats.quaternions[0] = 0
    splats.log_scales[1] = 30
    write_spz(tmp_path / "a.spz", splats)
    found = read_spz(tmp_path / "a.spz")
    assert found.means[:, 0].tolist() == [4e6, 0, 1, 0]
    assert all(torch.isfinite(values).all() for _, values in found.items())
    assert found.quaternions[0].abs().tolist() == [1, 0, 0, 0]
    splats.means[0, 0] = 1e7
    with pytest.raises(RtgsError, match=r"a position of 1e\+07 is beyond"):
        write_spz(tmp_path / "a.spz", splats)


def test_damaged_files_are_refused_by_name(tmp_path):
    write_spz(tmp_path / "a.spz", some(Surfels, 5))
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    huge = struct.pack("<IIIBBBB", 0x5053474E, 3, 20_000_000, 0, 12, 0, 0)
    cases = {
        "cut": gzip.compress(data[:-1]),
        "more": gzip.compress(data + b"x"),
        "count": gzip.compress(huge + data[16:]),
        "version": gzip.compress(data[:4] + b"\x04" + data[5:]),
        "plain": data,
        "empty": b"",
        "stream": (tmp_path / "a.spz").read_bytes()[:-9],
    }
    for name, content in cases.items():
        (tmp_path / f"{name}.spz").write_bytes(content)
        with pytest.raises(RtgsError, match=f"{name}.spz is no SPZ file"):
            read_spz(tmp_path / f"{name}.spz")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_spz(tmp_path / "gone.spz")
