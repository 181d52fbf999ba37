"""Normal maps of photos by tiny networks with the ports and conventions of the real ones, up to the training."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from pipelines.cli.main import main
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.normals.adapters import ADAPTERS, NormalAdapter
from rtgs.prepare.normals.make import make_normals
from rtgs.prepare.settings import NormalSettings
from rtgs.scenes.images import read_normals, read_photo
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings
from tests.prepare import tiny_networks
from tests.prepare.room import HEIGHT, WIDTH, write_normal_capture


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
