"""Photos, masks and normal maps of every kind Pillow opens."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from rtgs.scenes.images import (
    area_resize,
    has_alpha,
    image_size,
    nearest_resize,
    read_mask,
    read_normals,
    read_photo,
    same_aspect,
    target_size,
)
from rtgs.scenes.settings import CaptureError, SceneSettings

COLOR = np.random.default_rng(0).integers(0, 256, (12, 20, 3)).astype(np.uint8)
GREY = COLOR[..., 0]


def saved(tmp_path, picture, name="a.png", **options):
    picture.save(tmp_path / name, **options)
    return tmp_path / name


def test_eight_bit_colour_and_grey(tmp_path):
    np.testing.assert_allclose(read_photo(saved(tmp_path, Image.fromarray(COLOR))), COLOR / np.float32(255))
    grey = read_photo(saved(tmp_path, Image.fromarray(GREY)))
    assert grey.shape == (12, 20, 3)
    assert grey.dtype == np.float32
    np.testing.assert_allclose(grey, np.repeat(GREY[..., None], 3, 2) / np.float32(255))


def test_sixteen_bit_grey_keeps_its_precision(tmp_path):
    grey = (np.arange(240).reshape(12, 20) * 273).astype(np.uint16)
    photo = read_photo(saved(tmp_path, Image.fromarray(grey)))
    np.testing.assert_allclose(photo[..., 1], grey / 65535, atol=1e-7)


def test_palette_cmyk_and_bilevel(tmp_path):
    palette = Image.fromarray(COLOR).quantize(256)
    np.testing.assert_allclose(
        read_photo(saved(tmp_path, palette)), np.asarray(palette.convert("RGB")) / 255, atol=1e-6
    )
    cmyk = saved(tmp_path, Image.fromarray(COLOR).convert("CMYK"), "a.tif")
    assert np.abs(read_photo(cmyk) * 255 - COLOR).max() < 2
    assert set(np.unique(read_photo(saved(tmp_path, Image.fromarray(GREY > 100))))) == {0.0, 1.0}


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_alpha_is_composited(tmp_path, mode):
    picture = Image.fromarray(COLOR).convert(mode)
    picture.putalpha(51)
    path = saved(tmp_path, picture)
    flat = np.asarray(picture.convert("RGB")) / 255
    np.testing.assert_allclose(read_photo(path, (0.5, 0.0, 1.0)), 0.2 * flat + [0.4, 0.0, 0.8], atol=1e-6)
    assert has_alpha(path)
    assert not has_alpha(saved(tmp_path, Image.fromarray(COLOR), "b.png"))


def test_float_images_must_be_in_range(tmp_path):
    path = saved(tmp_path, Image.fromarray(GREY.astype(np.float32) / 255), "a.tif")
    np.testing.assert_allclose(read_photo(path)[..., 2], GREY / 255, atol=1e-6)
    with pytest.raises(CaptureError, match=r"values from .* to 25[0-9]: only images of 8 or 16 bits"):
        read_photo(saved(tmp_path, Image.fromarray(GREY.astype(np.float32)), "a.tif"))


@pytest.mark.parametrize("expected", [None, (20, 12), (12, 20), (24, 40)])
def test_exif_orientation_follows_the_camera(tmp_path, expected):
    exif = Image.Exif()
    exif[0x0112] = 8
    path = saved(tmp_path, Image.fromarray(COLOR), exif=exif)
    photo = read_photo(path, expected=expected)
    turned = expected is not None and expected[0] < expected[1]
    assert photo.shape == ((20, 12, 3) if turned else (12, 20, 3))
    np.testing.assert_allclose(photo, (np.rot90(COLOR) if turned else COLOR) / np.float32(255))
    assert image_size(path) == (20, 12)


def test_masks_are_non_zero_pixels(tmp_path):
    mask = np.zeros((4, 6), dtype=np.uint8)
    mask[1, 2:5] = (1, 128, 255)
    expected = mask > 0
    np.testing.assert_array_equal(read_mask(saved(tmp_path, Image.fromarray(mask))), expected)
    np.testing.assert_array_equal(read_mask(saved(tmp_path, Image.fromarray(expected))), expected)
    np.testing.assert_array_equal(read_mask(saved(tmp_path, Image.fromarray(mask.astype(np.uint16) * 256))), expected)
    color = np.zeros((4, 6, 4), dtype=np.uint8)
    color[1, 2:5, 2] = 9
    color[..., 3] = 255
    color[1, 2, 3] = 0
    expected[1, 2] = False
    np.testing.assert_array_equal(read_mask(saved(tmp_path, Image.fromarray(color))), expected)
    labels = Image.fromarray(mask > 0).convert("P")
    np.testing.assert_array_equal(read_mask(saved(tmp_path, labels)), mask > 0)


@pytest.mark.parametrize("mode", ["L", "RGB", "CMYK"])
def test_the_black_of_a_jpeg_mask_is_not_exact(tmp_path, mode):
    y, x = np.mgrid[:48, :64]
    disc = (x - 31.5) ** 2 + (y - 23.5) ** 2 < 15**2
    path = tmp_path / "mask.jpg"
    Image.fromarray(disc.astype(np.uint8) * 255).convert(mode).save(path, quality=60)
    raw = np.asarray(Image.open(path).convert("L"))
    assert int(((raw > 0) & ~disc).sum()) > 50, "blocks at the outline are grey"
    assert int((read_mask(path) != disc).sum()) <= 4


def test_normals_of_both_kinds_and_frames(tmp_path):
    normals = np.random.default_rng(1).normal(size=(5, 7, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    path = saved(tmp_path, Image.fromarray(np.round((normals + 1) / 2 * 255).astype(np.uint8)))
    np.testing.assert_allclose(read_normals(path), normals, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(read_normals(path), axis=-1), 1, atol=1e-5)
    np.save(tmp_path / "n.npy", np.moveaxis(normals, -1, 0))
    np.testing.assert_allclose(read_normals(tmp_path / "n.npy"), normals, atol=1e-6)
    np.testing.assert_allclose(read_normals(tmp_path / "n.npy", "opengl"), normals * [1, -1, -1], atol=1e-6)
    np.save(tmp_path / "n.npy", np.zeros((5, 7, 3)))
    assert (read_normals(tmp_path / "n.npy") == 0).all()


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((5, 7)), r"shape \(5, 7\)"),
        (np.zeros((5, 7, 3), dtype=np.uint8), "type uint8"),
        (np.full((5, 7, 3), np.nan), "NaN"),
        (np.array(["a", {}], dtype=object), "cannot be read"),
    ],
)
def test_bad_normal_arrays(tmp_path, array, message):
    np.save(tmp_path / "n.npy", array)
    with pytest.raises(CaptureError, match=message):
        read_normals(tmp_path / "n.npy")


def test_target_sizes():
    def size(width, height, **keys):
        return target_size(width, height, SceneSettings(**keys))

    assert size(799, 532, long_side=400) == (400, 266)
    assert size(449, 800, long_side=200) == (112, 200)
    assert size(100, 50, long_side=400) == (100, 50)
    assert size(1000, 1, long_side=10) == (10, 1)
    assert size(4947, 3287, resize_ratio=0.25) == (1236, 821)  # EnvGS truncates
    assert size(4947, 3287, resize_ratio=0.25, long_side=2000) == (1236, 821)
    assert size(4947, 3287, resize_ratio=0.25, long_side=495) == (495, 329)
    assert size(4947, 3287) == (4947, 3287)


def test_resizing_averages_areas_and_takes_centres():
    image = np.random.default_rng(2).random((6, 9, 3)).astype(np.float32)
    expected = image.reshape(2, 3, 3, 3, 3).mean((1, 3))
    np.testing.assert_allclose(area_resize(image, 3, 2), expected, atol=1e-6)
    uneven = area_resize(image, 4, 6)  # 9 columns in 4: each covers 2.25
    np.testing.assert_allclose(uneven[:, 0], (image[:, 0] + image[:, 1] + 0.25 * image[:, 2]) / 2.25, atol=1e-6)
    mask = np.arange(54).reshape(6, 9)
    np.testing.assert_array_equal(nearest_resize(mask, 3, 2), mask[1::3, 1::3])
    np.testing.assert_array_equal(nearest_resize(mask, 18, 12), mask.repeat(2, 0).repeat(2, 1))


def test_same_aspect_allows_a_pixel():
    assert same_aspect((400, 266), (799, 532))
    assert same_aspect((31, 24), (127, 99))
    assert not same_aspect((600, 800), (800, 600))
    assert not same_aspect((64, 40), (64, 48))
