"""Normals from tiny networks with the ports and conventions of the real ones, on photos that show their own normals."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from pipelines.cli.main import main  # noqa: E402
from rtgs.core.errors import RtgsError  # noqa: E402
from rtgs.prepare.errors import PrepareError  # noqa: E402
from rtgs.prepare.masks.makers import file_digest  # noqa: E402
from rtgs.prepare.normals.adapters import ADAPTERS, NormalAdapter  # noqa: E402
from rtgs.prepare.normals.make import find_network, make_normals  # noqa: E402
from rtgs.prepare.normals.maps import (  # noqa: E402
    SurfaceSample,
    canonical_normals,
    judge_axes,
    predict_normals,
    sample_surface,
    surface_normals,
)
from rtgs.prepare.normals.tiles import Tiling, cut, predict_tiled, ramps  # noqa: E402
from rtgs.prepare.onnx import Network  # noqa: E402
from rtgs.prepare.pretrained import REGISTRY, MissingWeights, WrongWeights  # noqa: E402
from rtgs.prepare.settings import NormalSettings  # noqa: E402
from rtgs.scenes.images import read_normals, read_photo, unit_or_zero  # noqa: E402
from rtgs.scenes.scene import load_scene  # noqa: E402
from rtgs.scenes.settings import SceneSettings  # noqa: E402
from rtgs.scenes.undistort import Lens, project, undistortion_map  # noqa: E402
from tests.prepare import tiny_networks  # noqa: E402
from tests.prepare.room import FOCAL, HEIGHT, WIDTH, normal_photo, walk, write_normal_capture  # noqa: E402

CALIBRATION = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return write_normal_capture(tmp_path_factory.mktemp("normals") / "room")


def make(capture: Path, tmp_path: Path, settings: NormalSettings, **scene):
    said: list[str] = []
    out = tmp_path / "out"
    out.mkdir(exist_ok=True)
    report = make_normals(SceneSettings(path=str(capture), **scene), settings, tmp_path / "cache", out, 1, said.append)
    return report, out, said


@pytest.mark.parametrize("family", sorted(ADAPTERS))
def test_every_family_gives_the_same_canonical_normals(family, capture, tmp_path):
    adapter = ADAPTERS[family]
    beside = ("normal_confidence", "predicted_depth") if family == "metric3d" else ()
    path = tiny_networks.color_reader(tmp_path / "net.onnx", adapter, beside=beside)
    report, out, said = make(capture, tmp_path, NormalSettings(model=family, file=str(path)))
    maps = read_normals(out / "normals/photo_01.png.npy")
    truth = 2 * read_photo(capture / "images/photo_01.png") - 1
    cosine = (maps * truth).sum(axis=-1)
    assert maps.shape == (HEIGHT, WIDTH, 3)
    assert np.median(cosine) > 0.999
    assert (cosine > 0.98).mean() > 0.9, "resizing blurs only the edges"
    assert report.verdict is not None
    assert report.verdict.agreement > 0.9
    assert report.verdict.facing > 0.95
    assert not report.verdict.flipped
    assert "points agree with a mean cosine of" in said[-1]
    assert json.loads((out / "normals.json").read_text())["maps"] == 4


AXES = [
    ("-x", "+y", "+z"),
    ("+x", "-y", "+z"),
    ("+x", "+y", "-z"),
    ("+x", "-y", "-z"),
    ("-x", "-y", "-z"),
    ("+z", "+y", "+x"),  # blue, green, red
]


@pytest.mark.parametrize("axes", AXES, ids=",".join)
def test_a_wrong_axis_is_caught_and_named(axes, capture, tmp_path):
    """The network speaks the axes above and is declared as x right, y down, z forward."""
    truth = NormalAdapter(axes=axes)
    path = tiny_networks.color_reader(tmp_path / "net.onnx", truth)
    settings = NormalSettings(model="custom", file=str(path), max_side=160)
    named = r"set normals.axes=\[" + ",".join(axes).replace("+", r"\+")
    with pytest.raises(PrepareError, match=named):
        make(capture, tmp_path, settings)
    report, _, _ = make(capture, tmp_path, replace(settings, axes=axes))
    assert report.verdict is not None
    assert report.verdict.agreement > 0.9
    ignored, _, said = make(capture, tmp_path, replace(settings, check=False))
    assert ignored.verdict is not None
    assert ignored.verdict.flipped
    assert "declared wrongly" in said[-1]


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


def test_maps_are_made_once_for_each_photo(capture, tmp_path, monkeypatch):
    path = tiny_networks.color_reader(tmp_path / "net.onnx", NormalAdapter())
    settings = NormalSettings(model="custom", file=str(path))
    first, _, _ = make(capture, tmp_path, settings, max_views=2)
    assert (first.maps, first.from_cache) == (2, 0)
    again, _, _ = make(capture, tmp_path, settings)
    assert (again.maps, again.from_cache) == (4, 2), "the two photos of before are not done again"
    tiled, _, _ = make(capture, tmp_path, replace(settings, tile=128))
    assert tiled.from_cache == 0
    smaller, out, _ = make(capture, tmp_path, replace(settings, max_side=160))
    assert smaller.from_cache == 0
    assert read_normals(out / "normals/photo_00.png.npy").shape == (120, 160, 3)


def test_the_maps_are_what_the_import_reads(capture, tmp_path):
    path = tiny_networks.color_reader(tmp_path / "net.onnx", ADAPTERS["omnidata"])
    _, out, _ = make(capture, tmp_path, NormalSettings(model="omnidata", file=str(path)))
    settings = SceneSettings(path=str(capture), normals_dir=str((out / "normals").absolute()), long_side=160)
    scene = load_scene(settings)
    view = scene.train[0]
    assert view.normal is not None
    truth = 2 * view.image - 1
    assert float((view.normal * truth).sum(dim=0).median()) > 0.99


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


def test_projection_follows_the_distortion():
    lens = Lens("OPENCV", 120, 90, (80.0, 82.0, 61.0, 44.0, 0.05, -0.02, 0.001, 0.002))
    grid, target = undistortion_map(lens), lens.pinhole()
    fx, fy, cx, cy = target.params
    rays = np.array([[(30.5 - cx) / fx, (20.5 - cy) / fy, 1.0]]) * 3
    np.testing.assert_allclose(project(lens, rays)[0], grid[:, 20, 30] + 0.5, atol=1e-3)
    plain = Lens("PINHOLE", 120, 90, (80.0, 82.0, 61.0, 44.0))
    np.testing.assert_allclose(project(plain, np.array([[1.0, 2.0, 4.0]])), [[81.0, 85.0]])


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


def test_a_wrong_model_is_a_message(tmp_path, capture):
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


@pytest.mark.parametrize(
    ("make_settings", "message"),
    [
        (lambda: NormalAdapter(axes=("+x", "+y", "+y")), "must be three of"),
        (lambda: NormalAdapter(fit="crop"), "normals.adapter.fit='crop'"),
        (lambda: NormalSettings(model="dsin"), "did you mean 'dsine'"),
        (lambda: NormalSettings(model="custom"), "needs normals.file"),
        (lambda: NormalSettings(tile=20), "normals.tile=20 must be 0"),
        (lambda: NormalSettings(tile_overlap=0.7), "normals.tile_overlap=0.7"),
        (lambda: find_network(NormalSettings(file="/nowhere/net.onnx")), "does not exist"),
    ],
)
def test_settings_out_of_range_are_refused(make_settings, message):
    with pytest.raises(RtgsError, match=message):
        make_settings()


def test_the_digest_of_the_file_is_checked(tmp_path):
    path = tiny_networks.color_reader(tmp_path / "net.onnx", NormalAdapter())
    _, digest = find_network(NormalSettings(file=str(path)))
    assert find_network(NormalSettings(file=str(path), sha256=digest.upper()))[0] == path
    with pytest.raises(PrepareError, match="it is another file"):
        find_network(NormalSettings(file=str(path), sha256="0" * 64))


def test_noted_digests_are_checked(tmp_path, monkeypatch, capsys):
    """``sha256sum */*.onnx > SHA256SUMS`` in the folder of weights pins what is in it."""
    monkeypatch.setenv("RTGS_WEIGHTS", str(tmp_path))
    path = tiny_networks.color_reader(tmp_path / "normals/dsine.onnx", ADAPTERS["dsine"])
    _, digest = find_network(NormalSettings(model="dsine"))
    sums = tmp_path / "SHA256SUMS"
    sums.write_text(f"{'0' * 64}  sam2/encoder.onnx\n{digest}  normals/dsine.onnx\n")
    assert find_network(NormalSettings(model="dsine"))[1] == file_digest(path) == digest
    sums.write_text(f"{'0' * 64} *./normals/dsine.onnx\n")
    for find in (lambda: find_network(NormalSettings(model="dsine")), lambda: file_digest(path)):
        with pytest.raises(WrongWeights, match=r"dsine.onnx has SHA-256 .*SHA256SUMS beside it says 0000"):
            find()
    assert main(["weights", "status"]) == 0
    assert "SHA256SUMS beside it says 0000000000000000" in capsys.readouterr().out
    sums.write_text("normals/dsine.onnx\n")
    with pytest.raises(WrongWeights, match="is no line of sha256sum"):
        find_network(NormalSettings(model="dsine"))


def test_unit_range_and_axes():
    channels = np.broadcast_to(np.float32([0.5, 0.5, 0.0]), (4, 4, 3))
    adapter = NormalAdapter(axes=("+x", "-y", "+z"), unit_range=True)
    np.testing.assert_allclose(canonical_normals(channels, adapter)[0, 0], [0, 0, -1])


def plan(capsys, *words: str) -> dict[str, list[str]]:
    assert main(["plan", *words, "tracking=off"]) == 0
    rows = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines()]
    return {row[0]: row[1:] for row in rows if len(row) > 2}


def test_the_plan_says_why_there_are_no_normals(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path / "root"))
    monkeypatch.setenv("RTGS_WEIGHTS", str(tmp_path / "weights"))
    scene = f"scene.path={capture}"
    assert "weights missing: normals/stablenormal.onnx" in " ".join(plan(capsys, scene)["normals"])
    assert "no loss reads them" in " ".join(plan(capsys, scene, "method.loss.mono_normal=0.0")["normals"])
    assert "normals.use=never" in " ".join(plan(capsys, scene, "normals=none")["normals"])
    assert "normal maps are given (48 of 48" in " ".join(plan(capsys, "scene=demo")["normals"])
    assert main(["plan", scene, "normals.use=always", "tracking=off"]) == 1
    assert "weights missing" in capsys.readouterr().err
    tiny_networks.color_reader(tmp_path / "weights/normals/dsine.onnx", ADAPTERS["dsine"])
    assert plan(capsys, scene, "normals=dsine", "method.loss.mono_normal=0.01")["normals"][1].startswith("to run")


def test_normals_reach_the_training(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path / "root"))
    monkeypatch.setenv("RTGS_WEIGHTS", str(tmp_path / "weights"))
    tiny_networks.color_reader(tmp_path / "weights/normals/omnidata.onnx", ADAPTERS["omnidata"])
    words = ["run", f"scene.path={capture}", "normals=omnidata", "preset=smoke", "scene.long_side=48", "tracking=off"]
    words += ["schedule.total=6", "schedule.checkpoint_every=3", "threads=1", "method.loss.mono_normal=0.01"]
    assert main(words) == 0
    (run,) = (path for path in (tmp_path / "root/runs").iterdir() if path.is_dir())
    page = (run / "report.html").read_text()
    assert "normals" in page
    assert "no monocular normal loss" not in page
    assert "4 maps by omnidata; predicted normals and the surfaces of" in page
    single = list((tmp_path / "root/store/single_normals").glob("*.npy"))
    assert len(single) == 4


def test_the_registry_is_one(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("RTGS_WEIGHTS", str(tmp_path))
    tiny_networks.color_reader(tmp_path / "normals/dsine.onnx", ADAPTERS["dsine"])
    assert main(["weights", "status"]) == 0
    shown = capsys.readouterr().out
    for name in ("vgg16", "lpips_vgg", "grounding_dino", "sam2_encoder", "sam2_decoder", *ADAPTERS):
        assert f"\n{name}: " in f"\n{shown}"
        assert REGISTRY[name].filename in shown
    _, digest = find_network(NormalSettings(model="dsine"))
    assert f"not registered, yours is {digest}" in shown
    with pytest.raises(MissingWeights, match=r"weights missing: normals/metric3d.onnx .*Made by"):
        find_network(NormalSettings(model="metric3d"))
