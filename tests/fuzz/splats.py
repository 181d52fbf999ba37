"""Readers of Gaussians in the formats that rtgs writes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from rtgs.export.compressed_ply import read_compressed_ply, write_compressed_ply
from rtgs.export.glass import GlassObject
from rtgs.export.gltf import read_glb, write_glb
from rtgs.export.spz import read_spz, write_spz
from rtgs.gaussians.ply import read_gaussians, read_ply, write_ply
from rtgs.gaussians.surfels import Surfels
from tests.fuzz.reader import Reader, files_of


def _gaussians(*, text: bool) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        random = torch.Generator().manual_seed(0)
        shapes = {"means": (6, 3), "log_scales": (6, 2), "quaternions": (6, 4), "opacity_logits": (6,)}
        shapes |= {"sh_dc": (6, 3), "sh_rest": (6, 3, 3)}
        tensors = {name: torch.randn(shape, generator=random) for name, shape in shapes.items()}
        write_ply(folder / "a.ply", Surfels(**tensors))
        if text:
            import plyfile

            stored = plyfile.PlyData.read(str(folder / "a.ply"), mmap=False)  # it is written over
            stored.text = True
            stored.write(str(folder / "a.ply"))

    return write


def _read_gaussians(folder: Path) -> None:
    gaussians = read_gaussians(folder / "a.ply")
    assert all(torch.isfinite(values).all() for _, values in gaussians.items())


def _write_glb(folder: Path) -> None:
    _gaussians(text=False)(folder)
    corners = np.eye(3, dtype=np.float32)
    glass = GlassObject(corners, corners, np.array([[0, 1, 2]]), 1.5, (1.0, 1.0, 1.0), 0.0)
    write_glb(folder / "a.glb", read_ply(folder / "a.ply"), glass=glass)


def _read_glb(folder: Path) -> None:
    found = read_glb(folder / "a.glb")
    assert all(torch.isfinite(values).all() for _, values in found.splats.items())
    assert np.isfinite(found.vertices).all()
    assert not len(found.faces) or found.faces.max() < len(found.vertices)


def _write_compressed(folder: Path) -> None:
    _gaussians(text=False)(folder)
    write_compressed_ply(folder / "b.ply", read_ply(folder / "a.ply"))


def _read_compressed(folder: Path) -> None:
    assert all(torch.isfinite(values).all() for _, values in read_compressed_ply(folder / "b.ply").items())


def _write_spz(folder: Path) -> None:
    _gaussians(text=False)(folder)
    write_spz(folder / "a.spz", read_ply(folder / "a.ply"))


def _read_spz(folder: Path) -> None:
    assert all(torch.isfinite(values).all() for _, values in read_spz(folder / "a.spz").items())


SPLATS = (
    Reader("splat", files_of(_gaussians(text=False)), ("a.ply",), _read_gaussians),
    Reader("splat text", files_of(_gaussians(text=True)), ("a.ply",), _read_gaussians),
    Reader("glb", files_of(_write_glb), ("a.glb",), _read_glb),
    Reader("spz", files_of(_write_spz), ("a.spz",), _read_spz),
    Reader("compressed splat", files_of(_write_compressed), ("b.ply",), _read_compressed),
)
