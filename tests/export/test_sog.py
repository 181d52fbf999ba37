"""SOG through splat-transform: a stand-in for the program here, and the program where it is installed."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.export.formats import splat_format
from rtgs.export.sog import TOOL, read_sog, write_sog
from rtgs.gaussians.surfels import Surfels
from rtgs.render.orbit import Orbit, Picture, orbit_cameras
from rtgs.render.splats import render_splats
from rtgs.train.held_out import psnr_of
from tests.export.test_bake import some

COPIES = """#!{python}
import shutil, sys
if {fails}: sys.exit("the file is " + "bad")
shutil.copyfile(*sys.argv[-2:])
"""


def stand_in(folder: Path, monkeypatch, fails: bool = False) -> None:
    """A program of the name that copies its first file to its second."""
    program = folder / TOOL
    program.write_text(COPIES.format(python=sys.executable, fails=fails))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))


@pytest.mark.skipif(os.name != "posix", reason="the stand-in is a script")
def test_the_program_gets_a_ply_and_its_file_comes_back(tmp_path, monkeypatch):
    stand_in(tmp_path, monkeypatch)
    splats = some(Surfels, 20, 2)
    chosen = splat_format("sog")
    write_sog(tmp_path / "a.sog", splats)
    assert (tmp_path / "a.sog").read_bytes().startswith(b"ply\n")
    found = chosen.read(tmp_path / "a.sog")
    assert isinstance(found, Surfels)
    assert torch.equal(found.sh_rest, splats.sh_rest)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.sog", TOOL]


@pytest.mark.skipif(os.name != "posix", reason="the stand-in is a script")
def test_what_the_program_says_is_told(tmp_path, monkeypatch):
    stand_in(tmp_path, monkeypatch, fails=True)
    with pytest.raises(RtgsError, match=r"a\.sog: .*splat-transform ended with code 1: the file is bad"):
        write_sog(tmp_path / "a.sog", some(Surfels, 5))
    assert not (tmp_path / "a.sog").exists()
    (tmp_path / "b.sog").write_bytes(b"x")
    with pytest.raises(RtgsError, match=r"b\.sog: .*the file is bad"):
        read_sog(tmp_path / "b.sog")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_sog(tmp_path / "gone.sog")


def test_without_the_program_the_message_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RtgsError, match="format=sog: splat-transform writes it and is not on PATH: `npm install"):
        splat_format("sog")
    with pytest.raises(RtgsError, match="is not on PATH"):
        write_sog(tmp_path / "a.sog", some(Surfels, 5))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which(TOOL) is None, reason=f"no {TOOL} here")
def test_the_program_itself_keeps_the_picture(tmp_path):
    splats = some(Surfels, 300, 3)
    write_sog(tmp_path / "a.sog", splats)
    found = read_sog(tmp_path / "a.sog")
    assert isinstance(found, Surfels)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    for camera in orbit_cameras(Orbit(torch.zeros(3, dtype=torch.float64), 3.0, up), Picture(48, 36, 40.0), 2):
        assert psnr_of(render_splats(found, camera), render_splats(splats, camera).clamp(0, 1)) > 28
