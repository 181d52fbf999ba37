"""``rtgs show RUN``: films of a run from anywhere, and what the words may be."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.cli.main import main
from pipelines.cli.show_run import ShowWords, parse_words
from rtgs.core.errors import RtgsError
from rtgs.evaluate.images import to_bytes
from rtgs.gaussians.materials import with_materials
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.gaussians.settings import MaterialSettings
from rtgs.runs.shown import locate_run, open_run
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)


@pytest.fixture(scope="module")
def run(root, capture) -> Path:
    """A run with reflections, from its first step on."""
    words = [f"scene={capture}", "method=envgs", "method.reflection.start=0.25", "name=mirror", *QUICK]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setenv("RTGS_ROOT", str(root))
        assert main(["run", *words]) == 0
    return root / "runs" / "mirror"


def test_the_report_says_what_the_layers_are_in_the_symbols_of_the_method(run):
    assert "what mirrored light adds: k_s w_r C_r" in (run / "report.html").read_text(encoding="utf-8")


def test_the_run_ends_with_a_preview_that_the_report_shows(run):
    with Image.open(run / "preview.webp") as opened:
        assert opened.n_frames == 24  # type: ignore[attr-defined]
        assert opened.size == (32, 24)
    assert "data:image/webp;base64," in (run / "report.html").read_text(encoding="utf-8")


def test_frames_and_films_of_every_layer(run, capsys):
    assert main(["show", "mirror", "layer=all", "frames=3", "fps=5", "threads=1"]) == 0
    told = capsys.readouterr().out
    assert "final, diffuse, reflection, normal, depth, weights from 3 cameras, path orbit" in told
    out = run / "shown" / "orbit-all"
    pictures = [np.asarray(Image.open(path)) for path in sorted((out / "frames").glob("*.png"))]
    assert len(pictures) == 3
    assert (pictures[0] != pictures[1]).any()
    assert (out / "preview.webp").is_file()
    assert sorted(path.name for path in out.iterdir()) == ["film.mp4", "frames", "preview.webp"]


def test_a_folder_of_other_frames_is_left_alone(run, tmp_path, capsys):
    photo = tmp_path / "film" / "frames" / "IMG_1.jpg"
    photo.parent.mkdir(parents=True)
    photo.write_bytes(b"the only copy")
    assert main(["show", "mirror", "frames=1", "format=png", f"out={tmp_path / 'film'}", "threads=1"]) == 1
    assert f"{photo} is no frame of a film" in capsys.readouterr().err
    assert photo.read_bytes() == b"the only copy"


def test_a_photos_camera_sees_what_the_run_rendered(run):
    """From the place of a test view, given as a camera path, the picture is the one of the run."""
    shown = open_run(run)
    view = shown.scene.test[0]
    maps = shown.maps(view.camera)
    (file,) = (run / "renders").glob(f"*{Path(view.name).stem}.png")
    rendered = np.asarray(Image.open(file).convert("RGB"))
    assert (to_bytes(maps["image"]) == rendered).all()
    torch.testing.assert_close(
        maps["image"], (1 - maps["specular"]) * maps["diffuse"] + maps["reflection"], atol=1e-5, rtol=0
    )
    shown_weight = maps["reflection_weight"] * maps["reflected_color"]
    torch.testing.assert_close(maps["reflection"], shown_weight, atol=1e-5, rtol=0)


def test_a_camera_path_of_nerfstudio(run, tmp_path, capsys):
    turn = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1]
    content = {"render_width": 20, "render_height": 16, "camera_path": [{"camera_to_world": turn, "fov": 60}]}
    (tmp_path / "walk.json").write_text(json.dumps(content))
    out = tmp_path / "out"
    assert main(["show", str(run), f"path={tmp_path / 'walk.json'}", "format=png", f"out={out}"]) == 0
    (frame,) = (out / "frames").glob("*.png")
    assert Image.open(frame).size == (20, 16)
    assert main(["show", str(run), f"path={tmp_path / 'walk.json'}", "size=10x8", "format=webp", f"out={out}"]) == 0
    assert Image.open(out / "preview.webp").size == (10, 8)
    assert main(["show", str(run), "path=nowhere.json"]) == 1
    assert "path=nowhere.json: there is no such file; a path is one of orbit, camera" in capsys.readouterr().err


def test_a_set_of_a_run_says_that_it_is_one_layer(run, tmp_path, capsys):
    words = ["--frames", "1", "--size", "16x12", "--out", str(tmp_path / "out")]
    assert main(["show", str(run / "point_cloud.ply"), *words]) == 0
    told = capsys.readouterr().out
    assert "one of 2 sets" in told
    assert "the others are reflection.ply" in told
    assert f"rtgs show {run}" in told
    alone = with_materials(read_gaussians(run / "reflection.ply"), MaterialSettings())
    write_ply(tmp_path / "alone.ply", alone)
    assert main(["show", str(tmp_path / "alone.ply"), *words]) == 0
    assert "have materials" in capsys.readouterr().out
    write_ply(tmp_path / "plain.ply", read_gaussians(run / "reflection.ply", channels=()))
    assert main(["show", str(tmp_path / "plain.ply"), *words]) == 0
    assert "note:" not in capsys.readouterr().out


def test_the_newest_run_is_shown_and_what_is_gone_is_told(run, root, tmp_path, capsys):
    assert locate_run(root, None) == run
    assert locate_run(root, str(run)) == run
    copied = tmp_path / "runs" / "mirror"
    shutil.copytree(run, copied)
    with pytest.raises(
        RtgsError, match=r"mirror: import_scene, .*train_reflection.* is not in .*; `rtgs run .*` makes"
    ):
        open_run(copied)
    assert main(["show", "nothing"]) == 1
    assert "no finished run 'nothing'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a", "b"], "a and b: one run at a time"),
        (["frames=0"], "frames=0 must be a whole number from 1 to 20000"),
        (["size=8"], "size=8 is no size such as 640x480"),
        (["format=gif"], "format=gif holds 'gif': choose some of png, mp4, webp"),
        (["layers=final"], "did you mean layer="),
        (["fps=2", "fps=3"], "fps= is given twice"),
        (["a", "--frames"], "--frames is for FILE.ply"),
    ],
)
def test_words_that_are_refused(words, message):
    with pytest.raises(RtgsError, match=message):
        parse_words(words)


def test_all_words_are_optional():
    assert parse_words([]) == ShowWords()
    assert parse_words(["a", "size=20x10", "format=png,webp"]) == ShowWords("a", size=(20, 10), format=("png", "webp"))
