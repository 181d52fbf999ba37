"""Splat files that are none: refused before memory or time is taken for them."""

from __future__ import annotations

import time

import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.gaussians.surfels import Surfels


@pytest.fixture
def splat(tmp_path):
    shapes = {"means": (6, 3), "log_scales": (6, 2), "quaternions": (6, 4), "opacity_logits": (6,)}
    shapes |= {"sh_dc": (6, 3), "sh_rest": (6, 3, 3)}
    write_ply(tmp_path / "a.ply", Surfels(**{name: torch.ones(shape) for name, shape in shapes.items()}))
    return tmp_path / "a.ply"


@pytest.mark.parametrize("count", [7, 10**12, 10**17])
def test_forged_counts_are_refused(splat, count):
    splat.write_bytes(splat.read_bytes().replace(b"vertex 6", b"vertex %d" % count))
    with pytest.raises(RtgsError, match=rf"a.ply is damaged or truncated: it announces {count} vertex"):
        read_gaussians(splat)


def test_a_header_line_of_50_megabytes_is_not_read(splat):
    splat.write_bytes(b"ply\ncomment " + b"x" * 50_000_000)
    before = time.process_time()
    with pytest.raises(RtgsError, match=r"a.ply is not a PLY file: a line of its header is longer than 4096"):
        read_gaussians(splat)
    assert time.process_time() - before < 5
