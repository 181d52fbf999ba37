"""Normals from tiny networks with the ports and conventions of the real ones, on photos that show their own normals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from pipelines.cli import main  # noqa: E402
from rtgs.prepare.adapters import ADAPTERS, NormalAdapter  # noqa: E402
from rtgs.prepare.errors import PrepareError  # noqa: E402
from rtgs.prepare.normal_maps import (  # noqa: E402
    canonical_normals,
    judge_axes,
    predict_normals,
    sample_surface,
    surface_normals,
)
from rtgs.prepare.normals import find_network, make_normals  # noqa: E402
from rtgs.prepare.onnx import Network  # noqa: E402
from rtgs.prepare.settings import NormalSettings  # noqa: E402
from rtgs.prepare.weights import REGISTRY, MissingWeights  # noqa: E402
from rtgs.scenes.images import read_normals, read_photo  # noqa: E402
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
    channels = 4 if family == "metric3d" else 3
    path = tiny_networks.color_reader(tmp_path / "net.onnx", adapter, channels)
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


@pytest.mark.parametrize("axes", [("+x", "-y", "+z"), ("-x", "+y", "+z"), ("-x", "-y", "-z"), ("+x", "-y", "-z")])
def test_a_wrong_axis_is_caught_and_named(axes, capture, tmp_path):
    """The network speaks the axes above and is declared as x right, y down, z forward."""
    truth = NormalAdapter(axes=axes)
    path = tiny_networks.color_reader(tmp_path / "net.onnx", truth)
    settings = NormalSettings(model="custom", file=str(path))
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


def test_maps_are_made_once_for_each_photo(capture, tmp_path, monkeypatch):
    path = tiny_networks.color_reader(tmp_path / "net.onnx", NormalAdapter())
    settings = NormalSettings(model="custom", file=str(path))
    first, _, _ = make(capture, tmp_path, settings, max_views=2)
    assert (first.maps, first.from_cache) == (2, 0)
    again, _, _ = make(capture, tmp_path, settings)
    assert (again.maps, again.from_cache) == (4, 2), "the two photos of before are not done again"
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


def test_the_calibration_moves_with_the_picture(tmp_path):
    """A network that tells fx, fy and cx of its input in units that make vectors about one long."""
    helper = onnx.helper
    picks = np.array([[0, 0], [1, 1]], dtype=np.int64)
    nodes = [
        helper.make_node("Squeeze", ["intrins", "first"], ["k"]),
        helper.make_node("GatherND", ["k", "picks"], ["focal"]),
        helper.make_node("Mul", ["focal", "unit"], ["scaled"]),
        helper.make_node("Concat", ["scaled", "nothing"], ["vector"], axis=0),
        helper.make_node("Reshape", ["vector", "shape"], ["column"]),
        helper.make_node("Mul", ["image", "zero"], ["blank"]),
        helper.make_node("Add", ["blank", "column"], ["normal"]),
    ]
    constants = {
        "first": np.array([0], dtype=np.int64),
        "picks": picks,
        "unit": np.float32(1 / 400),
        "nothing": np.zeros(1, dtype=np.float32),
        "shape": np.array([1, 3, 1, 1], dtype=np.int64),
        "zero": np.float32(0),
    }
    inputs = [("image", [1, 3, "h", "w"]), ("intrins", [1, 3, 3])]
    path = tiny_networks.save(tmp_path / "k.onnx", nodes, inputs, [("normal", [1, 3, "h", "w"])], constants)
    adapter = NormalAdapter(intrinsics="intrins", size=320, multiple=32)
    photo = np.zeros((400, 640, 3), dtype=np.float32)
    calibration = np.array([[500.0, 0, 320], [0, 600.0, 200], [0, 0, 1]])
    told = predict_normals(Network(path), adapter, photo, calibration)[0, 0]
    expected = np.array([500 * 320 / 640, 600 * 192 / 400, 0])
    np.testing.assert_allclose(told, expected / np.linalg.norm(expected), atol=1e-5)


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
        (lambda: NormalAdapter(axes=("+x", "+y", "+y")), "give three of"),
        (lambda: NormalAdapter(fit="crop"), "normals.adapter.fit='crop'"),
        (lambda: NormalSettings(model="dsin"), "did you mean 'dsine'"),
        (lambda: NormalSettings(model="custom"), "needs normals.file"),
        (lambda: find_network(NormalSettings(file="/nowhere/net.onnx")), "does not exist"),
    ],
)
def test_settings_out_of_range_are_refused(make_settings, message):
    with pytest.raises(PrepareError, match=message):
        make_settings()


def test_the_digest_of_the_file_is_checked(tmp_path):
    path = tiny_networks.color_reader(tmp_path / "net.onnx", NormalAdapter())
    _, digest = find_network(NormalSettings(file=str(path)))
    assert find_network(NormalSettings(file=str(path), sha256=digest.upper()))[0] == path
    with pytest.raises(PrepareError, match="it is another file"):
        find_network(NormalSettings(file=str(path), sha256="0" * 64))


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
