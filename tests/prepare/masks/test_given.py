"""Given masks in the layouts of other tools."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rtgs.core.errors import RtgsError
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.given import given_files, mask_file, read_given
from rtgs.prepare.masks.settings import GivenSettings
from rtgs.scenes.capture import CaptureView
from rtgs.scenes.settings import CaptureError
from rtgs.scenes.undistort import Lens

HEIGHT, WIDTH = 30, 40
INSIDE = np.zeros((HEIGHT, WIDTH), dtype=bool)
INSIDE[8:20, 10:30] = True
LENS = Lens("PINHOLE", WIDTH, HEIGHT, (40.0, 40.0, 20.0, 15.0))


def view(root: Path, name: str = "a/photo_1.jpg") -> CaptureView:
    image = root / "images" / name
    image.parent.mkdir(parents=True, exist_ok=True)
    if not image.is_file():
        Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)).save(image)
    return CaptureView(name, image, np.eye(3), np.zeros(3), LENS)


def saved(path: Path, pixels: np.ndarray, **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


@pytest.mark.parametrize(
    "name",
    [
        "a/photo_1.jpg.png",
        "a/photo_1.png",
        "a/photo_1_mask.png",
        "a/mask_photo_1.png",
        "photo_1.png",
        "photo_1.jpg.png",
    ],
)
def test_masks_are_found_under_the_names_tools_give_them(tmp_path, name):
    path = saved(tmp_path / "masks" / name, INSIDE.astype(np.uint8) * 255)
    assert mask_file(tmp_path / "masks", "a/photo_1.jpg") == path
    assert given_files([view(tmp_path)], tmp_path / "masks", GivenSettings()) == {"a/photo_1.jpg": path}


def test_values_that_mean_inside(tmp_path):
    seen = view(tmp_path)
    grey = saved(tmp_path / "grey.png", np.where(INSIDE, 1, 0).astype(np.uint8))
    assert (read_given(grey, seen, GivenSettings()) == INSIDE).all(), "anything but zero"
    assert not read_given(grey, seen, GivenSettings(threshold=0.5)).any()
    assert (read_given(grey, seen, GivenSettings(inverted=True)) == ~INSIDE).all()
    deep = saved(tmp_path / "deep.png", np.where(INSIDE, 50000, 20000).astype(np.uint16))
    assert (read_given(deep, seen, GivenSettings(threshold=0.5)) == INSIDE).all()
    noisy = np.where(INSIDE, 250, 0) + np.random.default_rng(0).integers(0, 5, INSIDE.shape)
    lossy = saved(tmp_path / "lossy.jpg", noisy.astype(np.uint8), quality=95)
    assert (read_given(lossy, seen, GivenSettings()) == INSIDE).mean() > 0.98, "JPEG is cut in the middle"


def test_label_images(tmp_path):
    seen = view(tmp_path)
    labels = np.where(INSIDE, 7, 3).astype(np.uint8)
    labels[0, 0] = 9
    grey = saved(tmp_path / "labels.png", labels)
    assert (read_given(grey, seen, GivenSettings(labels=(7,))) == INSIDE).all()
    assert read_given(grey, seen, GivenSettings(labels=(7, 9)))[0, 0]
    palette = Image.fromarray(labels, mode="P")
    palette.putpalette([value for index in range(256) for value in (index, 0, 255 - index)])
    palette.save(tmp_path / "palette.png")
    assert (read_given(tmp_path / "palette.png", seen, GivenSettings(labels=(7,))) == INSIDE).all()
    colored = np.where(INSIDE[..., None], [0, 255, 64], [200, 0, 0]).astype(np.uint8)
    path = saved(tmp_path / "colors.png", colored)
    assert (read_given(path, seen, GivenSettings(label_colors=("#00ff40",))) == INSIDE).all()
    with pytest.raises(RtgsError, match="is no colour such as"):
        GivenSettings(label_colors=("green",))
    with pytest.raises(RtgsError, match="exclude each other"):
        GivenSettings(labels=(1,), label_colors=("#000000",))


def test_the_alpha_channel_of_the_photos(tmp_path):
    pixels = np.dstack([np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8), INSIDE.astype(np.uint8) * 255])
    photo = replace(view(tmp_path), image=saved(tmp_path / "photo.png", pixels))
    settings = GivenSettings(layout="alpha")
    assert given_files([photo], tmp_path / "nowhere", settings) == {photo.name: photo.image}
    assert (read_given(photo.image, photo, settings) == INSIDE).all()
    with pytest.raises(PrepareError, match="has no alpha channel"):
        read_given(view(tmp_path).image, photo, settings)


def test_other_sizes(tmp_path):
    seen = view(tmp_path)
    half = saved(tmp_path / "half.png", INSIDE[::2, ::2].astype(np.uint8))
    assert read_given(half, seen, GivenSettings()).shape == (HEIGHT // 2, WIDTH // 2), "the import brings it to size"
    exif = Image.Exif()
    exif[0x0112] = 6  # shown after a quarter turn
    stored = tmp_path / "turned.jpg"
    Image.fromarray(np.zeros((WIDTH, HEIGHT, 3), dtype=np.uint8)).save(stored, exif=exif)
    lying = np.rot90(INSIDE)  # as the camera stored it
    path = saved(tmp_path / "lying.png", lying.astype(np.uint8) * 255)
    assert (read_given(path, replace(seen, image=stored), GivenSettings()) == INSIDE).all()
    with pytest.raises(
        PrepareError, match=r"is 30x40, its photo a/photo_1.jpg 40x30: any size will do, but the aspect"
    ):
        read_given(path, seen, GivenSettings())


def test_what_is_not_there_is_a_message(tmp_path):
    seen = view(tmp_path)
    with pytest.raises(PrepareError, match=r"does not exist: name the folder with masks.given.folder"):
        given_files([seen], tmp_path / "masks", GivenSettings())
    saved(tmp_path / "masks/other.png", INSIDE.astype(np.uint8))
    with pytest.raises(PrepareError, match=r"none of the 1 photos \(a/photo_1.jpg ...\) has a mask in .*other.png"):
        given_files([seen], tmp_path / "masks", GivenSettings())
    (tmp_path / "broken.png").write_bytes(b"no picture")
    with pytest.raises(CaptureError, match="cannot be read"):
        read_given(tmp_path / "broken.png", seen, GivenSettings())
    with pytest.raises(RtgsError, match="must be a share in"):
        GivenSettings(threshold=3)
