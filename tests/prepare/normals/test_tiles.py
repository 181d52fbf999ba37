"""Photos cut into tiles and their normals put together: the same as of the whole photo, and without seams."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from rtgs.prepare.normals.adapters import ADAPTERS, NormalAdapter
from rtgs.prepare.normals.tiles import Tiling, cut, predict_tiled, ramps
from rtgs.prepare.onnx import Network
from rtgs.scenes.images import unit_or_zero
from tests.prepare import tiny_networks
from tests.prepare.room import CALIBRATION, normal_photo, walk


@pytest.mark.parametrize("family", ["dsine", "omnidata", "metric3d"])
def test_tiles_give_what_the_whole_photo_gives(family, tmp_path):
    """A network that looks at single pixels does not care how a photo is cut."""
    adapter = replace(ADAPTERS[family], size=128, box=(77, 133))
    network = Network(tiny_networks.color_reader(tmp_path / "net.onnx", adapter))
    photo = normal_photo(walk(1)[0]).astype(np.float32) / 255
    truth = unit_or_zero(2 * photo - 1)
    tiled = predict_tiled(network, adapter, photo, CALIBRATION, Tiling(128, 0.25))
    whole = predict_tiled(network, adapter, photo, CALIBRATION, Tiling(0, 0.25))
    assert tiled.shape == whole.shape == photo.shape
    assert np.median((tiled * truth).sum(axis=-1)) > 0.999
    assert (tiled * truth).sum(axis=-1).mean() > (whole * truth).sum(axis=-1).mean(), "more pixels, sharper edges"
    np.testing.assert_allclose(np.linalg.norm(tiled, axis=-1), 1, atol=1e-5)


def test_tiles_are_blended_without_seams(tmp_path):
    """A network that says one normal for its whole input; the photo's normals turn from left to right."""
    adapter = NormalAdapter(size=64, multiple=32)
    network = Network(tiny_networks.color_reader(tmp_path / "net.onnx", adapter, blurred=True))
    angle = np.broadcast_to(np.radians(np.linspace(-70, 70, 300)), (100, 300))
    normals = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1)
    photo = ((normals + 1) / 2).astype(np.float32)
    tiling = Tiling(100, 0.4)
    told = predict_tiled(network, adapter, photo, CALIBRATION, tiling)
    turned = np.degrees(np.arctan2(told[50, :, 0], -told[50, :, 2]))
    assert len(cut(300, tiling)) == 5
    assert np.diff(turned).min() > -1e-3, "it turns one way only"
    assert np.diff(turned).max() < 1.5, "degrees a pixel, where the tiles' own normals lie 24 degrees apart"
    assert turned[-1] - turned[0] > 80
    np.testing.assert_allclose(np.linalg.norm(told, axis=-1), 1, atol=1e-5)
    opposite = photo.copy()
    opposite[:, :150], opposite[:, 150:] = (0.5, 0.5, 0.0), (0.5, 0.5, 1.0)
    halves = predict_tiled(network, adapter, opposite, CALIBRATION, Tiling(160, 0.1))
    assert not halves[:, 150].any(), "tiles that contradict each other leave it open"
    np.testing.assert_allclose(halves[0, 0], [0, 0, -1], atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 400), st.integers(64, 200), st.floats(0, 0.5))
def test_tiles_cover_a_photo_evenly(length, side, overlap):
    tiles = cut(length, Tiling(side, overlap))
    assert tiles[0].start == 0
    assert tiles[-1].stop == length
    assert {tile.stop - tile.start for tile in tiles} == {min(side, length)}
    common = [before.stop - after.start for before, after in itertools.pairwise(tiles)]
    assert all(width >= int(side * overlap) for width in common)
    total = np.zeros(length)
    for tile, weight in zip(tiles, ramps(tiles)):
        assert weight.min() > 0
        total[tile] += weight
    np.testing.assert_allclose(total, 1)
