"""``rtgs outline``: photos from different sides on a page, and what a person clicks there as a file of marks."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.cli.main import main
from pipelines.cli.outline import PAGE, PHOTOS
from rtgs.prepare.masks.drawn import read_drawing
from rtgs.prepare.masks.outline_page import far_apart
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


def photos(page: Path) -> list[dict]:
    found = re.search(r'id="photos">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return json.loads(found[1])


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
