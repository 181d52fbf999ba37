"""Smaller files, the same pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rtgs.scenes.synthetic.shrink import shrink_pictures
from rtgs.scenes.truth import read_truth, write_truth
from tests.scenes.test_truth import drawn_truth

pytest.importorskip("oxipng", reason="the extra `synthetic` is not installed")


def test_pixels_and_scales_stay_and_files_get_smaller(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    smooth = np.cumsum(rng.normal(0, 2, (60, 80, 3)), axis=1).clip(-100, 100).astype(np.int16) + 128
    photo = Image.fromarray(smooth.astype(np.uint8))
    photo.save(tmp_path / "a.jpg", quality=95, subsampling=0)
    photo.save(tmp_path / "b.png", compress_level=1)
    truth = drawn_truth()
    write_truth(tmp_path / "truth", replace(truth, transmitted=torch.zeros_like(truth.transmitted)))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}
    pixels = {path: np.asarray(Image.open(path)) for path in before}
    truth = read_truth(tmp_path / "truth")

    saved = shrink_pictures(tmp_path)

    assert saved == sum(len(data) - path.stat().st_size for path, data in before.items())
    assert (tmp_path / "a.jpg").stat().st_size < len(before[tmp_path / "a.jpg"])
    assert (tmp_path / "b.png").stat().st_size < len(before[tmp_path / "b.png"])
    for path, value in pixels.items():
        np.testing.assert_array_equal(np.asarray(Image.open(path)), value)
    for name, value in read_truth(tmp_path / "truth").tensors().items():
        assert value.equal(truth.tensors()[name]), name
