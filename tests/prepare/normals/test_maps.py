"""One map from a network's output: frames and axes, the points it is judged by, the calibration, wrong networks."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from rtgs.prepare.errors import PrepareError  # noqa: E402
from rtgs.prepare.normals.adapters import ADAPTERS, NormalAdapter  # noqa: E402
from rtgs.prepare.normals.maps import (  # noqa: E402
    SurfaceSample,
    canonical_normals,
    judge_axes,
    predict_normals,
    sample_surface,
    surface_normals,
)
from rtgs.prepare.normals.tiles import Tiling, predict_tiled  # noqa: E402
from rtgs.prepare.onnx import Network  # noqa: E402
from rtgs.scenes.images import unit_or_zero  # noqa: E402
from rtgs.scenes.undistort import Lens  # noqa: E402
from tests.prepare import tiny_networks  # noqa: E402
from tests.prepare.room import CALIBRATION, HEIGHT, WIDTH, normal_photo, walk  # noqa: E402


def test_every_order_and_sign_of_axes_is_told_from_every_other():
    """Predictions with noise, brought to a wrong frame in each of the 48 ways and declared in another."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(300, 3)) - (0, 0, 1.5)
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    noisy = truth + rng.normal(scale=0.3, size=truth.shape)
    nothing = np.zeros(300, dtype=int)
    samples = SurfaceSample(nothing, nothing, truth, -truth)
    ways = [
        tuple(sign + axis for sign, axis in zip(signs, order))
        for order in itertools.permutations("xyz")
        for signs in itertools.product("+-", repeat=3)
    ]
    declared = NormalAdapter(axes=("-y", "+x", "-z"))
    for axes in ways:
        told = noisy @ NormalAdapter(axes=axes).matrix  # channels, as the network speaks
        verdict = judge_axes(told @ declared.matrix.T, samples, declared)
        assert verdict.best == axes
        assert verdict.flipped == (axes != declared.axes)
        assert verdict.best_agreement > 0.8
    few = SurfaceSample(nothing[:49], nothing[:49], truth[:49], -truth[:49])
    assert not judge_axes(-truth[:49], few, NormalAdapter()).flipped, "too few to stop a run for"


def test_points_without_flat_surfaces_are_not_judged():
    rng = np.random.default_rng(0)
    assert not surface_normals(rng.normal(size=(5, 3))).any()
    cloud = rng.normal(size=(400, 3))
    assert np.abs(surface_normals(cloud)).sum(axis=1).astype(bool).mean() < 0.2
    lens = Lens("PINHOLE", 100, 100, (80.0, 80.0, 50.0, 50.0))
    sample = sample_surface(cloud[:20] + np.array([0, 0, 5]), np.zeros((20, 3)), np.eye(3), np.zeros(3), lens)
    verdict = judge_axes(np.zeros((0, 3)), sample, NormalAdapter())
    assert "not checked against the points: only 0 points" in verdict.message
    assert not verdict.flipped


def calibration_reader(path: Path, *picks: tuple[int, int]) -> Path:
    """A network that tells two numbers of its calibration, in units that make vectors about one long."""
    helper = onnx.helper
    nodes = [
        helper.make_node("Squeeze", ["intrins", "first"], ["k"]),
        helper.make_node("GatherND", ["k", "picks"], ["told"]),
        helper.make_node("Mul", ["told", "unit"], ["scaled"]),
        helper.make_node("Concat", ["scaled", "nothing"], ["vector"], axis=0),
        helper.make_node("Reshape", ["vector", "shape"], ["column"]),
        helper.make_node("Mul", ["image", "zero"], ["blank"]),
        helper.make_node("Add", ["blank", "column"], ["normal"]),
    ]
    constants = {
        "first": np.array([0], dtype=np.int64),
        "picks": np.array(picks, dtype=np.int64),
        "unit": np.float32(1 / 400),
        "nothing": np.zeros(1, dtype=np.float32),
        "shape": np.array([1, 3, 1, 1], dtype=np.int64),
        "zero": np.float32(0),
    }
    inputs = [("image", [1, 3, "h", "w"]), ("intrins", [1, 3, 3])]
    return tiny_networks.save(path, nodes, inputs, [("normal", [1, 3, "h", "w"])], constants)


def test_the_calibration_moves_with_the_picture(tmp_path):
    """fx and fy where the whole photo is shrunk; cx and cy where a tile of it is."""
    photo = np.zeros((400, 640, 3), dtype=np.float32)
    calibration = np.array([[500.0, 0, 320], [0, 600.0, 200], [0, 0, 1]])
    adapter = NormalAdapter(intrinsics="intrins", size=320, multiple=32)
    focal = Network(calibration_reader(tmp_path / "focal.onnx", (0, 0), (1, 1)))
    told = predict_normals(focal, adapter, photo, calibration)[0, 0]
    expected = np.array([500 * 320 / 640, 600 * 192 / 400, 0])
    np.testing.assert_allclose(told, expected / np.linalg.norm(expected), atol=1e-5)
    photo, calibration = photo[:, :400], np.array([[500.0, 0, 360], [0, 500.0, 345], [0, 0, 1]])
    center = Network(calibration_reader(tmp_path / "center.onnx", (0, 2), (1, 2)))
    told = predict_tiled(center, adapter, photo, calibration, Tiling(256, 0.25))
    for row, column, start in ((0, 0, (0, 0)), (0, -1, (144, 0)), (-1, 0, (0, 144)), (-1, -1, (144, 144))):
        expected = np.array([360 - start[0], 345 - start[1], 0])
        np.testing.assert_allclose(told[row, column], expected / np.linalg.norm(expected), atol=1e-5)


def test_unit_range_and_axes():
    channels = np.broadcast_to(np.float32([0.5, 0.5, 0.0]), (4, 4, 3))
    adapter = NormalAdapter(axes=("+x", "-y", "+z"), unit_range=True)
    np.testing.assert_allclose(canonical_normals(channels, adapter)[0, 0], [0, 0, -1])


def test_a_wrong_model_is_a_message(tmp_path):
    photo = normal_photo(walk(1)[0]).astype(np.float32) / 255

    def refused(path: Path, adapter: NormalAdapter, message: str) -> None:
        with pytest.raises(PrepareError, match=message):
            predict_normals(Network(path), adapter, photo, CALIBRATION)

    good = tiny_networks.color_reader(tmp_path / "good.onnx", NormalAdapter())
    refused(good, NormalAdapter(input="pixels"), r"has no input 'pixels', but image \(1, 3, \?, \?\)")
    refused(good, NormalAdapter(output="n"), r"has no output 'n', but normal")
    refused(good, NormalAdapter(unit_range=True, axes=("+x", "+y", "+z")), "unit_range=true seems wrong")
    refused(good, NormalAdapter(channels_last=True), r"does not run on image \(1, 256, 320, 3\)|does not run on image")
    wants = tiny_networks.color_reader(tmp_path / "k.onnx", ADAPTERS["dsine"])
    refused(wants, NormalAdapter(), "also wants intrins")
    weights, bias = np.ones((1, 3, 1, 1), dtype=np.float32), np.zeros(1, dtype=np.float32)
    node = onnx.helper.make_node("Conv", ["image", "weights", "bias"], ["depth"])
    inputs, outputs = [("image", [1, 3, "h", "w"])], [("depth", [1, 1, "h", "w"])]
    more = onnx.helper.make_node("Concat", ["image", "image"], ["normal"], axis=1)
    wide = tiny_networks.save(tmp_path / "w.onnx", [more], inputs, [("normal", [1, 6, "h", "w"])], {})
    assert predict_normals(Network(wide), NormalAdapter(), unit_or_zero(photo + 1), CALIBRATION).shape == (
        HEIGHT,
        WIDTH,
        3,
    )
    depth = tiny_networks.save(tmp_path / "d.onnx", [node], inputs, outputs, {"weights": weights, "bias": bias})
    refused(depth, NormalAdapter(), r"gives depth of shape \(1, 1, .*normals are \(1, 3, H, W\)")
    fixed = tiny_networks.save(
        tmp_path / "f.onnx",
        [onnx.helper.make_node("Identity", ["image"], ["normal"])],
        [("image", [1, 3, 64, 64])],
        [("normal", [1, 3, 64, 64])],
        {},
    )
    refused(fixed, NormalAdapter(), r"does not run on image \(1, 3, .*it wants image \(1, 3, 64, 64\)")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(PrepareError, match="no ONNX file onnxruntime can run"):
        Network(tmp_path / "text.onnx")
    with np.errstate(all="ignore"):
        refused(good, NormalAdapter(std=(0.0, 1.0, 1.0)), "NaN or inf")
