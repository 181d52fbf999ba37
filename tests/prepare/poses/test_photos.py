"""Folders of photos as people have them: turned, broken, repeated, of several sizes, in formats nobody reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.poses import photos
from rtgs.prepare.poses.find import check_count
from rtgs.prepare.poses.photos import lay_out, read_photo_set, write_ignored
from rtgs.prepare.settings import SfmSettings

ORIENTATION, MAKE, MODEL, EXIF, FOCAL_35MM = 0x0112, 0x010F, 0x0110, 0x8769, 0xA405
SIZE = (64, 48)


def save(
    path: Path, size: tuple[int, int] = SIZE, orientation: int = 1, focal: int | None = None, seed: int = 0
) -> Path:
    """A photo that is dark above and bright below, with EXIF data."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 60, (size[1], size[0], 3), dtype=np.uint8)
    pixels[size[1] // 2 :] += 180
    picture = Image.fromarray(pixels)
    exif = picture.getexif()
    exif[ORIENTATION], exif[MAKE], exif[MODEL] = orientation, "Maker", "One"
    if focal:
        exif.get_ifd(EXIF)[FOCAL_35MM] = focal
    picture.save(path, exif=exif)
    return path


def laid_out(folder: Path, target: Path, background=(0.0, 0.0, 0.0)) -> dict[str, Image.Image]:
    found = read_photo_set(folder)
    lay_out(found, target, background, lambda _: None)
    return {name: Image.open(target / name) for name in found.names}


def test_turned_photos_are_laid_out_upright_and_keep_their_focal_length(tmp_path):
    save(tmp_path / "in/a.jpg", focal=28)
    save(tmp_path / "in/b.jpg", orientation=6, focal=28, seed=1)
    pictures = laid_out(tmp_path / "in", tmp_path / "out")
    assert pictures["a.jpg"].size == SIZE
    assert (tmp_path / "out/a.jpg").is_symlink(), "what needs no change is not copied"
    turned = pictures["b.jpg"]
    assert turned.size == SIZE[::-1]
    pixels = np.asarray(turned.convert("L")).astype(int)
    assert pixels[:, :20].mean() > pixels[:, -20:].mean() + 100, "the lower half of the stored photo is now on the left"
    assert turned.getexif()[ORIENTATION] == 1
    assert turned.getexif().get_ifd(EXIF)[FOCAL_35MM] == 28
    found = read_photo_set(tmp_path / "in")
    assert {photo.camera for photo in found.photos} == {"Maker One 28 mm"}
    said = [finding.what for finding in found.findings]
    assert said[-1] == "1 of 2 photos are stored on their side and turned upright as EXIF says: b.jpg"


@pytest.mark.parametrize("orientation", [2, 3, 5, 8])
def test_every_orientation_matches_pillow(tmp_path, orientation):
    from PIL import ImageOps

    path = save(tmp_path / "in/a.png", orientation=orientation)
    expected = np.asarray(ImageOps.exif_transpose(Image.open(path)))
    np.testing.assert_array_equal(np.asarray(laid_out(tmp_path / "in", tmp_path / "out")["a.png"]), expected)


def test_other_formats_become_what_colmap_reads(tmp_path):
    folder = tmp_path / "in"
    save(folder / "a.jpg")
    save(folder / "b.tif", seed=1)
    alpha = np.zeros((48, 64, 4), dtype=np.uint8)
    alpha[:, :32] = 255
    Image.fromarray(alpha).save(folder / "c.png")
    Image.fromarray(np.full((48, 64), 40_000, dtype=np.uint16)).save(folder / "d.png")
    save(folder / "two words.jpg", seed=2)
    pictures = laid_out(folder, tmp_path / "out", background=(1.0, 0.0, 0.0))
    assert list(pictures) == ["a.jpg", "b.jpg", "c.png", "d.png", "two_words.jpg"], (
        "no blanks: COLMAP's lists have none"
    )
    assert all(picture.mode == "RGB" for picture in pictures.values())
    np.testing.assert_array_equal(np.asarray(pictures["c.png"])[0, -1], [255, 0, 0])
    assert abs(int(np.asarray(pictures["d.png"])[0, 0, 0]) - round(40_000 / 65_535 * 255)) <= 1


def test_names_that_would_collide_stay_apart(tmp_path):
    for number, name in enumerate(("a b.jpg", "a_b.jpg", "a_b.tif", "a_b.png")):
        save(tmp_path / "in" / name, seed=number)
    pictures = laid_out(tmp_path / "in", tmp_path / "out")
    assert len(pictures) == 4
    assert len({np.asarray(picture).tobytes() for picture in pictures.values()}) == 4


def test_heic_is_read_where_the_package_is_there(tmp_path):
    pillow_heif = pytest.importorskip("pillow_heif")
    pixels = np.full((64, 64, 3), 200, dtype=np.uint8)
    (tmp_path / "in").mkdir()
    pillow_heif.from_pillow(Image.fromarray(pixels)).save(tmp_path / "in/a.heic", quality=90)
    picture = laid_out(tmp_path / "in", tmp_path / "out")["a.jpg"]
    assert abs(np.asarray(picture).astype(int) - 200).max() < 6


def test_heic_without_the_package_is_a_message(tmp_path, monkeypatch):
    monkeypatch.setattr(photos, "open_heic", lambda: False)
    save(tmp_path / "a.jpg")
    (tmp_path / "b.heic").write_bytes(b"something")
    found = read_photo_set(tmp_path)
    assert found.names == ("a.jpg",)
    assert "1 of 2 photos cannot be read" in found.findings[0].message
    assert "pip install -e '.[prepare]'" in found.findings[0].message


def test_broken_photos_are_left_out_and_named(tmp_path):
    save(tmp_path / "a.jpg")
    whole = save(tmp_path / "b.jpg", seed=1).read_bytes()
    (tmp_path / "b.jpg").write_bytes(whole[: len(whole) // 3])
    (tmp_path / "c.jpg").write_bytes(b"")
    (tmp_path / "d.png").write_text("no picture")
    (tmp_path / "._a.jpg").write_bytes(b"what a Mac leaves behind")
    found = read_photo_set(tmp_path)
    assert found.names == ("a.jpg",)
    (finding,) = found.findings
    assert "3 of 4 photos cannot be read" in finding.what
    assert [item.split(":")[0] for item in finding.items] == ["b.jpg", "c.jpg", "d.png"]


def test_nothing_readable_is_an_error(tmp_path):
    (tmp_path / "a.jpg").write_text("no picture")
    with pytest.raises(PrepareError, match=r"none of the 1 photos .* can be read: a\.jpg"):
        read_photo_set(tmp_path)


def test_mixed_sizes_get_a_lens_each_and_a_word(tmp_path):
    for index in range(4):
        save(tmp_path / f"a{index}.jpg", focal=28, seed=index)
    save(tmp_path / "b.jpg", size=(96, 64), focal=28, seed=9)
    found = read_photo_set(tmp_path)
    assert len({photo.group for photo in found.photos}) == 2
    (finding,) = found.findings
    assert finding.severity == "info"
    assert "4 of 64x48 (Maker One 28 mm), 1 of 96x64" in finding.what


def test_photos_cropped_one_by_one_are_warned_of(tmp_path):
    for index in range(5):
        save(tmp_path / f"a{index}.jpg", size=(64 + index, 48), seed=index)
    (finding,) = read_photo_set(tmp_path).findings
    assert finding.severity == "warning"
    assert "use the originals" in finding.message


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "no photos in .* but nothing"),
        (["notes.txt"], "no photos in .*but notes.txt"),
        (["a.dng", "b.dng"], "2 raw files .*export them as JPEG"),
        (
            ["day1/a.jpg", "day2/b.jpg"],
            "no photos in .* itself, but in day1, day2: name the folder with scene.images_dir",
        ),
    ],
)
def test_a_folder_without_photos_says_what_it_holds(tmp_path, names, message):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    with pytest.raises(PrepareError, match=message):
        read_photo_set(tmp_path)


def test_two_photos_are_too_few(tmp_path):
    save(tmp_path / "a.jpg")
    save(tmp_path / "b.jpg", seed=1)
    with pytest.raises(PrepareError, match=r"2 usable photos .* at least 3, and a scene 20 or more"):
        check_count(read_photo_set(tmp_path), SfmSettings())


def test_masks_of_moving_things_join_and_turn_with_their_photo(tmp_path):
    save(tmp_path / "images/a.jpg", orientation=6)
    save(tmp_path / "images/b.jpg", seed=1)
    moving = np.zeros((48, 64), dtype=np.uint8)
    moving[:10] = 255  # above on the stored photo: on the right when upright
    for folder, name, mask in (("ignore", "a.png", moving), ("masks", "a.png", moving.T), ("masks", "b.png", moving)):
        (tmp_path / folder).mkdir(exist_ok=True)
        Image.fromarray(mask).save(tmp_path / folder / name)
    found = read_photo_set(tmp_path)
    assert write_ignored(found, [tmp_path / "ignore", tmp_path / "masks"], tmp_path / "out") == 2
    kept = np.asarray(Image.open(tmp_path / "out/a.jpg.png")) != 0
    assert kept.shape == (64, 48)
    assert not kept[:, -10:].any(), "turned with the photo"
    assert not kept[:, :10].any(), "a mask of the upright photo stays as it is"
    assert kept[:, 10:-10].all()


def test_a_mask_of_another_photo_is_refused(tmp_path):
    save(tmp_path / "a.jpg")
    (tmp_path / "ignore").mkdir()
    Image.fromarray(np.full((10, 100), 255, dtype=np.uint8)).save(tmp_path / "ignore/a.png")
    with pytest.raises(ValueError, match=r"100x10, its photo a.jpg 64x48"):
        write_ignored(read_photo_set(tmp_path), [tmp_path / "ignore"], tmp_path / "out")
