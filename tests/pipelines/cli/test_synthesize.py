"""``rtgs run synthesize``: cached, resumable, and clear about what is wrong."""

import ctypes.util
import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("mitsuba", reason="path tracing needs the extra 'synthetic'")

from pipelines.cli.main import main
from pipelines.steps.display import LineDisplay
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.synthetic import capture as captures
from rtgs.scenes.synthetic import variants
from rtgs.scenes.synthetic.record import CaptureRecord
from rtgs.scenes.truth_files import GLASS_MAPS, TRUTH_MAPS
from rtgs.workflow import Store

SCENE = """
title = "A ball in a room"
constant_light = [0.3, 0.3, 0.3]
[viewpoints]
count = 9
radius = [2.0, 2.2]
rings = 1
[[shape]]
name = "room"
kind = "box"
size = [3.0, 3.0, 3.0]
inward = true
material = { texture = "posters" }
[[shape]]
name = "ball"
kind = "sphere"
size = [0.5, 0.0, 0.0]
material = { kind = "KIND" }
"""
SMALL = ("width=16", "height=12", "samples=4", "test_samples=8", "features.points=200", "variant=scalar_rgb")


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """The command's words for a tiny scene, rendered in half a second."""
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path / "root"))
    file = tmp_path / "tiny.toml"
    file.write_text(SCENE.replace("KIND", "thin_glass"))
    return [f"scene={file}", *SMALL]


def artifacts(tmp_path):
    return list(Store(tmp_path / "root" / "store").artifacts("synthesize"))


def test_a_scene_becomes_a_capture_once(scene, tmp_path, capsys):
    assert main(["run", "synthesize", *scene, f"output={tmp_path / 'out'}"]) == 0
    (artifact,) = artifacts(tmp_path)
    assert str(tmp_path / "out" / "tiny") in capsys.readouterr().out
    loaded = load_scene(SceneSettings(path=str(tmp_path / "out" / "tiny")))
    assert (len(loaded.train), len(loaded.test)) == (7, 2)
    assert loaded.has_masks
    assert loaded.has_normals
    for view in loaded.test:
        assert view.truth is not None
        assert (view.truth.image - view.image).abs().mean() < 2 / 255  # the layers make the picture
        assert (view.truth.objects == 1).equal(view.mask)
    record = CaptureRecord.read(tmp_path / "out" / "tiny")
    assert record is not None
    assert record.renderer.endswith("scalar_rgb")
    assert (record.width, record.height, record.views, record.points) == (16, 12, 9, len(loaded.points))
    assert 10 < record.noise_psnr < 60
    assert record.reflected_in_mask is not None
    made = artifact.folder.stat().st_mtime_ns
    assert main(["run", "synthesize", *scene]) == 0
    (again,) = artifacts(tmp_path)
    assert again.folder.stat().st_mtime_ns == made
    assert main(["run", "synthesize", *scene, "seed=1"]) == 0
    assert len(artifacts(tmp_path)) == 2


def test_a_scene_without_glass_has_no_masks(scene, tmp_path):
    file = tmp_path / "tiny.toml"
    file.write_text(SCENE.replace("KIND", "glossy"))
    assert main(["run", "synthesize", *scene, "truth=test"]) == 0
    (artifact,) = artifacts(tmp_path)
    loaded = load_scene(SceneSettings(path=str(artifact.folder)))
    assert not loaded.has_masks
    assert sorted(path.name for path in (artifact.folder / "truth").iterdir()) == ["view_000", "view_008"]
    assert loaded.test[1].truth is not None
    assert loaded.test[1].truth.specular.any()


def test_a_full_disk_is_told_and_the_next_run_goes_on(scene, tmp_path, monkeypatch, capsys):
    rendered, save = [], Image.Image.save
    write_view = captures._write_view

    def counted(tracer, camera, index, *rest):
        rendered.append(index)
        write_view(tracer, camera, index, *rest)

    def full(self, path, **options):
        if "view_004" in str(path) and "normal" in str(path):
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        save(self, path, **options)

    monkeypatch.setattr(captures, "_write_view", counted)
    monkeypatch.setattr(Image.Image, "save", full)
    assert main(["run", "synthesize", *scene]) == 1
    message = capsys.readouterr().err
    assert "No space left on device" in message
    assert "free some space, then the same command goes on" in message
    assert artifacts(tmp_path) == []
    assert rendered == [0, 1, 2, 3, 4]
    monkeypatch.setattr(Image.Image, "save", save)
    assert main(["run", "synthesize", *scene]) == 0
    assert rendered == [0, 1, 2, 3, 4, 4, 5, 6, 7, 8]  # the half-written view again, the finished ones not
    (artifact,) = artifacts(tmp_path)
    assert len(list((artifact.folder / "images").iterdir())) == 9
    assert not list((tmp_path / "root" / "store" / "synthesize").rglob("*.tmp*"))

    monkeypatch.setenv("RTGS_ROOT", str(tmp_path / "uninterrupted"))
    assert main(["run", "synthesize", *scene]) == 0
    (whole,) = Store(tmp_path / "uninterrupted" / "store").artifacts("synthesize")
    for path in sorted(artifact.folder.rglob("*.*")):
        other = whole.folder / path.relative_to(artifact.folder)
        if path.name not in ("manifest.json", "synthetic.json"):  # which tell when and how long
            assert path.read_bytes() == other.read_bytes(), path


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["scene=nope"], "there is no scene 'nope'; rtgs describes ball_statue, "),
        (["width=64"], "name a scene, scene=NAME"),
        (["scene=spheres", "width=0"], "width=0 must be in 8..8192"),
        (["scene=spheres", "samples=0"], "samples=0 must be in 1.."),
        (["scene=spheres", "truth=some"], "truth='some' is unknown: choose one of all, test, none"),
        (["scene=spheres", "widht=64"], "Did you mean width"),
        (["scene=spheres", "variant=cuda_rgb"], "variant 'cuda_rgb' is not used here"),
    ],
)
def test_bad_words_are_refused_in_words(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))
    assert main(["run", "synthesize", *words]) == 1
    assert message in capsys.readouterr().err


def test_without_llvm_the_scalar_variant_renders_and_says_so(scene, monkeypatch, caplog):
    monkeypatch.setattr(variants, "find_llvm", lambda: None)
    with caplog.at_level("INFO"):
        assert main(["run", "synthesize", *[word for word in scene if not word.startswith("variant")]]) == 0
    assert "scalar_rgb, no LLVM 17 to 20 was found" in caplog.text


def test_output_never_replaces_what_is_no_synthetic_capture(scene, tmp_path, capsys):
    (tmp_path / "out" / "tiny").mkdir(parents=True)
    (tmp_path / "out" / "tiny" / "thesis.txt").write_text("years of work")
    assert main(["run", "synthesize", *scene, f"output={tmp_path / 'out'}"]) == 1
    assert artifacts(tmp_path) == []  # refused before any work
    assert "is no synthetic capture" in capsys.readouterr().err
    assert (tmp_path / "out" / "tiny" / "thesis.txt").read_text() == "years of work"


def test_a_copy_that_meets_a_full_disk_leaves_what_was_there(scene, tmp_path, monkeypatch, capsys):
    words = ["run", "synthesize", *scene, f"output={tmp_path / 'out'}"]
    assert main(words) == 0
    before = (tmp_path / "out" / "tiny" / "images" / "view_000.png").read_bytes()
    copyfile = shutil.copyfile

    def full(source, target):
        if "truth" in str(target):
            raise OSError(errno.ENOSPC, "No space left on device", str(target))
        return copyfile(source, target)

    monkeypatch.setattr(shutil, "copyfile", full)
    assert main(words) == 1
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.count("No space left on device") == 1
    assert "free some space" in message
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["tiny"]
    assert (tmp_path / "out" / "tiny" / "images" / "view_000.png").read_bytes() == before
    monkeypatch.setattr(shutil, "copyfile", copyfile)
    assert main(words) == 0
    assert len(list((tmp_path / "out" / "tiny" / "truth" / "view_008").iterdir())) == len(TRUTH_MAPS + GLASS_MAPS)
    assert not (tmp_path / "out" / "tiny" / "manifest.json").exists()


def test_a_library_that_is_no_llvm_is_told(tmp_path):
    """In a process of its own: the library is loaded once for all."""
    library = ctypes.util.find_library("m")
    folders = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/lib")
    found = [Path(folder) / str(library) for folder in folders if (Path(folder) / str(library)).is_file()]
    if not found:
        pytest.skip("no mathematics library in a usual place")
    code = "from rtgs.scenes.synthetic.variants import load_mitsuba; load_mitsuba('llvm_ad_rgb')"
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": str(found[0])}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "RtgsError: Mitsuba's llvm_ad_rgb does not start with" in done.stderr
    assert "take the variant scalar_rgb" in done.stderr


def test_help_names_scenes_and_keys(capsys):
    assert main(["run", "synthesize", "--help"]) == 0
    text = capsys.readouterr().out
    assert "ball_statue" in text
    assert "test_samples" in text


def test_remaining_time_counts_only_what_was_done_now(monkeypatch, capsys):
    clock = iter([100.0, 110.0, 130.0])
    monkeypatch.setattr("pipelines.steps.display.time.monotonic", lambda: next(clock))
    display = LineDisplay()
    for share in (0.5, 0.6, 0.8):  # half was finished earlier
        display.update("room view", share)
    assert capsys.readouterr().err.splitlines()[-1] == "room view: 80%, 0.3 min left"


def test_the_record_survives_a_round_trip_and_refuses_a_broken_file(tmp_path):
    from rtgs.scenes.settings import CaptureError

    assert CaptureRecord.read(tmp_path) is None
    (tmp_path / "synthetic.json").write_text(json.dumps({"name": "x"}))
    with pytest.raises(CaptureError, match=r"synthetic.json cannot be read"):
        CaptureRecord.read(tmp_path)


def test_the_noise_estimate_is_the_distance_to_the_converged_picture():
    """On a picture whose converged value is known."""
    from rtgs.scenes.synthetic.noise import noise_of_mean, psnr
    from rtgs.scenes.truth import srgb_from_linear

    rng = np.random.default_rng(0)
    light = rng.uniform(0.05, 0.9, (40, 40, 3))
    first, second = (light + rng.normal(0, 0.03, light.shape) for _ in range(2))
    truth = srgb_from_linear(light)
    actual = np.mean((srgb_from_linear((first + second) / 2) - truth) ** 2)
    assert psnr(noise_of_mean(first, second)) == pytest.approx(psnr(actual), abs=0.3)
