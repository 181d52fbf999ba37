"""Pseudo views in the store: pictures in 8 bit, cameras to the last digit, and what their models cost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from PIL import Image

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.runs.pseudo import RECORD, PseudoRecord, read_pseudo, write_picture
from rtgs.scenes.scene import View
from rtgs.train.clock import ElapsedTime

WIDTH, HEIGHT = 12, 8


def view(index: int) -> View:
    generator = torch.Generator().manual_seed(index)
    turned = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    rotation = turned * torch.linalg.det(turned).sign()
    place = torch.randn(3, generator=generator, dtype=torch.float64)
    camera = Camera(rotation, place, 20.3, 21.0, 6.1, 4.2, WIDTH, HEIGHT, name=f"pseudo view {index}")
    return View(camera, torch.rand(3, HEIGHT, WIDTH, generator=generator), None, None, camera.name)


def write(folder: Path, count: int = 3, visits: int = 3) -> list[View]:
    views = [view(index) for index in range(count)]
    entries = tuple(write_picture(folder, index, each) for index, each in enumerate(views))
    PseudoRecord(entries, visits, 40.0, 60.0, 512.0).write(folder)
    return views


def test_what_is_written_is_read(tmp_path: Path):
    views = write(tmp_path)
    found = read_pseudo(tmp_path)
    assert (found.spent, found.peak_memory_mb) == (ElapsedTime(40.0, 60.0), 512.0)
    for got, given in zip(found.views, views, strict=True):
        assert got.name == got.camera.name == given.name
        assert torch.equal(got.camera.rotation, given.camera.rotation)
        assert torch.equal(got.camera.translation, given.camera.translation)
        assert (got.camera.fx, got.camera.cy, got.camera.width) == (20.3, 4.2, WIDTH)
        assert got.image.dtype == torch.float32
        assert got.image.is_contiguous()
        assert float((got.image - given.image).abs().max()) <= 0.5 / 255 + 1e-6
        assert got.mask is None
        assert got.normal is None


def test_few_pictures_are_visited_in_turn(tmp_path: Path):
    write(tmp_path, count=3, visits=7)
    found = read_pseudo(tmp_path).views
    assert [each.name[-1] for each in found] == list("0120120")
    assert found[0] is found[3]  # one picture in memory


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"visits": 0}, "3 views for 0 visits"),
        ({"views": []}, "0 views for 3 visits"),
        ({"seconds": "long"}, "cannot be read as a record"),
    ],
)
def test_a_damaged_record_is_refused(tmp_path: Path, change: dict[str, object], says: str):
    write(tmp_path)
    (tmp_path / RECORD).write_text(json.dumps(json.loads((tmp_path / RECORD).read_text()) | change))
    with pytest.raises(RtgsError, match=says):
        read_pseudo(tmp_path)


def test_a_picture_of_another_size_is_refused(tmp_path: Path):
    write(tmp_path)
    Image.new("RGB", (WIDTH, HEIGHT + 1)).save(tmp_path / "images" / "00001.png")
    with pytest.raises(RtgsError, match=r"00001\.png"):
        read_pseudo(tmp_path)


def test_a_record_names_no_file_outside_its_folder(tmp_path: Path):
    write(tmp_path / "store")
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "other.png")
    content = json.loads((tmp_path / "store" / RECORD).read_text())
    content["views"][0]["file"] = "../other.png"
    (tmp_path / "store" / RECORD).write_text(json.dumps(content))
    with pytest.raises(RtgsError, match=r"\.\./other"):
        read_pseudo(tmp_path / "store")


def test_a_lens_that_is_none_is_refused(tmp_path: Path):
    write(tmp_path)
    content = json.loads((tmp_path / RECORD).read_text())
    content["views"][2]["fx"] = -3.0
    (tmp_path / RECORD).write_text(json.dumps(content))
    with pytest.raises(RtgsError, match="cannot be read as a record"):
        read_pseudo(tmp_path)
