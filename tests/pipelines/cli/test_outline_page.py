"""``rtgs outline``: photos from different sides on a page, and what a person clicks there as a file of marks."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.cli.main import main
from pipelines.cli.outline import PAGE, PHOTOS, _of_run
from rtgs.prepare.masks.drawn import read_drawing
from rtgs.prepare.masks.outline_page import far_apart, write_outline_page
from rtgs.scenes.capture import CaptureView
from rtgs.scenes.importers import registry
from rtgs.scenes.undistort import Lens, project, unproject
from tests.view import chromium

SIZE = (60, 40)
MARKS = "cutouts:\n  photos/a 3.jpg: {outline: [[6, 4], [30, 4], [30, 36]]}\n"


@pytest.fixture
def capture(tmp_path, monkeypatch) -> Path:
    """Twelve photos from cameras on a circle; their names have a folder and a space."""
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path / "root"))
    folder, frames = tmp_path / "vase <1>", []
    (folder / "photos").mkdir(parents=True)
    for index in range(12):
        name = f"photos/a {index}.jpg"
        Image.fromarray(np.full((SIZE[1], SIZE[0], 3), 20 * index, np.uint8)).save(folder / name)
        pose, angle = np.eye(4), index * np.pi / 6
        pose[:3, 3] = (np.cos(angle), np.sin(angle), 3.0)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    lens = {"w": SIZE[0], "h": SIZE[1], "fl_x": 50.0, "fl_y": 50.0, "cx": 30.0, "cy": 20.0, "camera_model": "PINHOLE"}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return folder


def data(page: Path) -> dict:
    found = re.search(r'id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def photos(page: Path) -> list[dict]:
    return data(page)["photos"]


def test_chosen_places_lie_far_apart():
    circle = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)]
    assert far_apart(circle, 4) == [0, 3, 6, 9]
    assert far_apart(circle, 20) == list(range(12))
    assert far_apart([np.zeros(3)] * 3, 2) == [0, 1]  # a camera that did not move


def test_a_page_beside_the_capture_shows_photos_from_all_sides(capture, capsys):
    assert main(["outline", str(capture)]) == 0
    page = capture / PAGE
    said = capsys.readouterr().out
    assert "masks.yaml" in said
    assert "method=rtgs" in said
    shown = photos(page)
    assert len(shown) == PHOTOS
    assert all(photo["size"] == list(SIZE) and photo["outline"] == [] for photo in shown)
    text = page.read_text(encoding="utf-8")
    assert "vase &lt;1&gt;" in text
    assert not re.search(r"(src|href)=[\"']?https?:", text)


def test_outlines_that_there_are_can_be_mended(capture):
    (capture / "masks.yaml").write_text(MARKS)
    assert main(["outline", str(capture)]) == 0
    (mine,) = (photo for photo in photos(capture / PAGE) if photo["name"] == "photos/a 3.jpg")
    np.testing.assert_allclose(mine["outline"], [[0.1, 0.1], [0.5, 0.1], [0.5, 0.9]])


@pytest.mark.parametrize("text", ["", "cutouts: [", "cutouts: {nobody.jpg: {outline: [[6, 4], [30, 4], [30, 36]]}}\n"])
def test_a_file_of_marks_that_cannot_be_read_is_named(capture, text, capsys):
    (capture / "masks.yaml").write_text(text)
    assert main(["outline", str(capture)]) != 0
    said = capsys.readouterr().err
    assert "masks.yaml" in said
    assert "remove it to begin anew" in said
    assert not (capture / PAGE).exists()
    assert (capture / "masks.yaml").read_text() == text


def test_marks_may_lie_in_a_folder_that_is_not_there_yet(capture):
    assert main(["outline", str(capture), "masks=polygon", "masks.drawn.file=marks/mine.yaml"]) == 0
    assert len(photos(capture / "marks" / PAGE)) == PHOTOS


def test_a_capture_may_have_an_equals_sign_in_its_name(capture):
    other = capture.rename(capture.with_name("seed=3"))
    assert main(["outline", str(other)]) == 0
    assert (other / PAGE).is_file()
    assert main(["check", str(other)]) == 0


@pytest.mark.parametrize("command", ["check", "outline"])
def test_a_capture_that_is_not_there_is_named_whatever_its_name(command, tmp_path, capsys):
    assert main([command, str(tmp_path / "seed=3")]) == 1
    said = capsys.readouterr()
    assert f"{tmp_path / 'seed=3'} does not exist" in said.out + said.err


def test_marks_that_are_no_outlines_stay(capture):
    pane = "panes:\n  door:\n" + "".join(f"    a {k}.jpg: [[6, 4], [30, 4], [30, 36]]\n" for k in (3, 5))
    (capture / "masks.yaml").write_text(pane + "cutouts: {a 4.jpg: {box: [6, 4, 30, 36], inside: [[12, 8]]}}\n")
    assert main(["outline", str(capture)]) == 0
    corners = [[0.1, 0.1], [0.5, 0.1], [0.5, 0.9]]
    assert data(capture / PAGE)["kept"] == {
        "panes": {"door": {"photos/a 3.jpg": corners, "photos/a 5.jpg": corners}},
        "cutouts": {"photos/a 4.jpg": {"box": [0.1, 0.1, 0.5, 0.9], "inside": [[0.2, 0.2]]}},
    }


def test_photos_that_were_undistorted_are_shown_as_they_were_taken(tmp_path):
    lens = Lens("SIMPLE_RADIAL", 300, 200, (220.0, 150.0, 100.0, 0.25))
    flat = Lens("PINHOLE", 300, 200, (220.0, 220.0, 150.0, 100.0))
    taken = np.array([[250.0, 160.0]])  # where a person sees a dot, before undistortion
    ((x, y),) = project(flat, unproject(lens, taken))
    assert abs(x - 250) > 5  # it matters
    pixels = np.zeros((200, 300, 3), np.uint8)
    pixels[round(y) - 3 : round(y) + 3, round(x) - 3 : round(x) + 3] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    view = CaptureView("a.png", tmp_path / "a.png", np.eye(3), np.zeros(3), flat)
    write_outline_page(tmp_path / PAGE, "a", [view], tmp_path / "masks.yaml", None, {"a.png": lens})
    (photo,) = photos(tmp_path / PAGE)
    with Image.open(io.BytesIO(base64.b64decode(photo["picture"].partition(",")[2]))) as picture:
        rows, columns = np.nonzero(np.asarray(picture)[..., 0] > 128)
    np.testing.assert_allclose((columns.mean() + 0.5, rows.mean() + 0.5), taken[0], atol=0.8)


@pytest.mark.skipif(chromium.browser() is None, reason="no Chromium (Debian: apt install chromium)")
def test_any_name_and_all_marks_are_in_the_file_that_the_page_gives(capture, tmp_path):
    frames = json.loads((capture / "transforms.json").read_text())
    names = ["photos/<img src=x>.jpg", "photos/a\"'{x}.jpg", "photos/on: [1] #\u2028.jpg", "photos/\U0001f600.jpg"]
    for frame, name in zip(frames["frames"], names):
        (capture / frame["file_path"]).rename(capture / name)
        frame["file_path"] = name
    (capture / "transforms.json").write_text(json.dumps(frames))
    pane = "panes:\n  door:\n" + "".join(f"    a {k}.jpg: [[6, 4], [30, 4], [30, 36]]\n" for k in (4, 5))
    (capture / "masks.yaml").write_text(pane + "cutouts: {a 6.jpg: {box: [6, 4, 30, 36], inside: [[12, 8]]}}\n")
    before = read_drawing(capture / "masks.yaml", [f"photos/a {k}.jpg" for k in (4, 5, 6)])
    main(["outline", str(capture)])
    with chromium.open_tab((capture / PAGE).as_uri(), tmp_path / "profile") as tab:
        tab.wait("!!document.querySelector('nav button')")
        tab.evaluate("photos.forEach((photo) => { photo.outline = [[.1, .1], [.9, .1], [.9, .9]]; }); show();")
        text = tab.evaluate("document.querySelector('textarea').value")
    (capture / "masks.yaml").write_text(text, encoding="utf-8")
    drawing, size = read_drawing(capture / "masks.yaml", None), np.array(SIZE)
    assert set(drawing.marked) == {photo["name"] for photo in photos(capture / PAGE)}
    assert any(name in drawing.cutouts for name in names)
    for name, corners in before.panes["door"].items():
        np.testing.assert_allclose(drawing.panes["door"][name] * size, corners, atol=0.01)
    mine = drawing.cutouts["photos/a 6.jpg"]
    np.testing.assert_allclose(np.reshape(mine.box, (2, 2)) * size, [[6, 4], [30, 36]], atol=0.01)
    assert len(mine.inside) == 1
    assert len(mine.outline) == 3


def test_photos_in_a_folder_that_is_named_have_a_page(capture, tmp_path, monkeypatch):
    bare = tmp_path / "bare"
    shutil.copytree(capture / "photos", bare / "taken")
    monkeypatch.setattr("pipelines.cli.outline._posed", lambda config, source: capture)
    read, asked = registry.read_capture, []
    monkeypatch.setattr(registry, "read_capture", lambda settings: asked.append(settings) or read(settings))
    assert main(["outline", str(bare), "scene.images_dir=taken"]) == 0
    assert [settings.images_dir for settings in asked] == [None]  # poses' folder has images/ only
    assert len(photos(bare / PAGE)) == PHOTOS


def test_the_run_that_follows_has_the_same_words():
    assert _of_run(["a b", "sfm.seed=1"]) == ["a b", "sfm.seed=1", "method=rtgs", "preset=quick"]
    assert _of_run(["a", "preset=smoke"]) == ["a", "preset=smoke", "method=rtgs"]


def test_masks_that_the_capture_brings_need_none(capture, capsys):
    frames = json.loads((capture / "transforms.json").read_text())
    (capture / "masks").mkdir()
    for frame in frames["frames"]:
        frame["mask_path"] = f"masks/{Path(frame['file_path']).stem}.png"
        Image.new("L", SIZE, 255).save(capture / frame["mask_path"])
    (capture / "transforms.json").write_text(json.dumps(frames))
    assert main(["outline", str(capture)]) == 0
    assert "masks are given" in capsys.readouterr().out
    assert not (capture / PAGE).exists()


def test_a_word_that_is_none_is_refused(capsys):
    assert main(["outline", "--photos"]) == 1
    assert "--photos is no word of it" in capsys.readouterr().err
    assert main(["outline"]) == 2


@pytest.mark.skipif(chromium.browser() is None, reason="no Chromium (Debian: apt install chromium)")
def test_what_is_clicked_in_a_browser_is_a_file_of_marks(capture, tmp_path):
    main(["outline", str(capture)])
    corners = [(0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.5, 0.5)]
    with chromium.open_tab((capture / PAGE).as_uri(), tmp_path / "profile") as tab:
        tab.wait("!!document.querySelector('nav button')")
        tab.evaluate("document.querySelectorAll('nav button')[1].click()")
        place = "(() => { const b = document.querySelector('svg image').getBoundingClientRect();"
        left, top, width, height = tab.evaluate(f"{place} return [b.x, b.y, b.width, b.height]; }})()")
        for x, y in corners:
            tab.click(left + x * width, top + y * height)
        tab.click(left + 0.9 * width, top + 0.9 * height)
        tab.evaluate("document.getElementById('undo').click()")
        tab.drag(left + 0.5 * width, top + 0.5 * height, -0.25 * width, 0.25 * height)
        text = tab.evaluate("document.querySelector('textarea').value")
        assert tab.evaluate("document.getElementById('count').textContent") == f"1 of {PHOTOS} photos have an outline"
        assert tab.evaluate("document.getElementById('save').disabled") is False
    (capture / "masks.yaml").write_text(text)
    name = photos(capture / PAGE)[1]["name"]
    drawing = read_drawing(capture / "masks.yaml", [name])
    expected = [*corners[:3], (0.25, 0.75)]
    np.testing.assert_allclose(drawing.shares(drawing.cutouts[name].outline, SIZE), expected, atol=0.01)
