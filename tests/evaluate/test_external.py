"""Pictures of another program: found by the views' names, refused with a clear word, read to the last digit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.evaluate.external import ExternalError, match_pictures, read_external
from rtgs.evaluate.layers import encoded
from rtgs.evaluate.settings import ExternalSettings

WIDTH, HEIGHT = 12, 8
TURN = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Photo:
    name: str
    camera: Camera
    image: Tensor


def photo(name: str, seed: int = 0) -> Photo:
    zero = torch.zeros(3, dtype=torch.float64)
    camera = Camera(TURN.double(), zero, 10.0, 10.0, 6.0, 4.0, WIDTH, HEIGHT, name)
    return Photo(name, camera, torch.rand((3, HEIGHT, WIDTH), generator=torch.Generator().manual_seed(seed)))


VIEWS = (photo("left/0001.jpg", 1), photo("left/0002.jpg", 2))


def pixels(image: Tensor) -> np.ndarray:
    return (image * 255).round().byte().permute(1, 2, 0).numpy()


def save(folder: Path, name: str, image: Tensor, **keys) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels(image)).save(path, **keys)
    return path


def settings(folder: Path, **keys) -> ExternalSettings:
    return ExternalSettings(renders=str(folder), **keys)


def complete(folder: Path, **keys) -> Path:
    for view in VIEWS:
        save(folder, f"{view.name[:-4]}.png", view.image, **keys)
    return folder


@pytest.mark.parametrize("form", ["left/0001.png", "left_0001.PNG", "left/0001.jpg.bmp", "left/0001.npy"])
def test_a_picture_is_found_by_its_views_name(tmp_path: Path, form: str):
    save(tmp_path, "left_0002.png", VIEWS[1].image)
    if form.endswith("npy"):
        (tmp_path / "left").mkdir()
        np.save(tmp_path / form, VIEWS[0].image.numpy())  # (3, H, W)
    else:
        save(tmp_path, form, VIEWS[0].image)
    (tmp_path / "notes.txt").write_text("no picture")
    image = read_external(settings(tmp_path), VIEWS).views["left/0001.jpg"]["image"]
    exact = form.endswith("npy")
    expected = VIEWS[0].image if exact else torch.from_numpy(pixels(VIEWS[0].image)).permute(2, 0, 1) / 255
    assert torch.equal(image, expected)


def test_pictures_of_no_test_view_are_counted_and_not_read(tmp_path: Path):
    complete(tmp_path)
    (tmp_path / "left" / "0003.png").write_bytes(b"damaged, and nobody's business")
    found = read_external(settings(tmp_path), VIEWS)
    assert found.notes == ("1 pictures in it are of no test view and are not read",)
    assert sorted(found.views) == ["left/0001.jpg", "left/0002.jpg"]


def test_missing_and_doubled_views_are_named(tmp_path: Path):
    save(tmp_path, "left_0001.png", VIEWS[0].image)
    with pytest.raises(ExternalError, match=r"lacks 1 of 2 test views: left/0002\.jpg; it has left_0001\.png"):
        read_external(settings(tmp_path), VIEWS)
    save(tmp_path, "left/0001.bmp", VIEWS[0].image)
    with pytest.raises(ExternalError, match=r"2 pictures of view 'left/0001\.jpg': left/0001\.bmp, left_0001\.png"):
        read_external(settings(tmp_path), VIEWS)
    with pytest.raises(ExternalError, match=r"external\.renders=.*nowhere is no folder"):
        read_external(settings(tmp_path / "nowhere"), VIEWS)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ExternalError, match="holds no pictures"):
        read_external(settings(tmp_path / "empty"), VIEWS)


def test_two_views_of_one_stem_are_not_given_one_picture(tmp_path: Path):
    save(tmp_path, "a.png", VIEWS[0].image)
    with pytest.raises(ExternalError, match=r"lacks 2 of 2 test views: a\.jpg, a\.png"):
        match_pictures(tmp_path, ["a.jpg", "a.png"], "external.renders")
    for name in ("a.jpg.png", "a.png.png"):
        save(tmp_path, name, VIEWS[0].image)
    found, others = match_pictures(tmp_path, ["a.jpg", "a.png"], "external.renders")
    assert {name: path.name for name, path in found.items()} == {"a.jpg": "a.jpg.png", "a.png": "a.png.png"}
    assert others == 1


def test_another_size_is_refused_or_shrunk_as_photos_are(tmp_path: Path):
    for view in VIEWS:
        save(tmp_path, f"{view.name[:-4]}.png", view.image.repeat_interleave(2, 1).repeat_interleave(2, 2))
    with pytest.raises(ExternalError, match=r"0001\.png is 24x16, the test view 12x8: external\.larger=shrink"):
        read_external(settings(tmp_path), VIEWS)
    found = read_external(settings(tmp_path, larger="shrink"), VIEWS)
    stored = torch.from_numpy(pixels(VIEWS[0].image)).permute(2, 0, 1) / 255
    torch.testing.assert_close(found.views["left/0001.jpg"]["image"], stored)
    assert found.notes == ("pictures of 24x16 were shrunk to the views' size as photos are",)
    save(tmp_path, "left/0001.png", VIEWS[0].image[:, :, :9])
    with pytest.raises(ExternalError, match=r"is 9x8, the test view 12x8: render the view's camera at its size"):
        read_external(settings(tmp_path, larger="shrink"), VIEWS)


def test_colors_that_say_they_are_others_are_refused(tmp_path: Path):
    from PIL import ImageCms, PngImagePlugin

    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    complete(tmp_path, icc_profile=profile)
    assert read_external(settings(tmp_path), VIEWS).notes == ()
    other = profile.replace("sRGB".encode("utf-16-be"), "wide".encode("utf-16-be")).replace(b"sRGB", b"wide")
    save(tmp_path, "left/0001.png", VIEWS[0].image, icc_profile=other)
    with pytest.raises(ExternalError, match=r"0001\.png has a colour profile that is not sRGB"):
        read_external(settings(tmp_path), VIEWS)
    assert read_external(settings(tmp_path, colors="srgb"), VIEWS).views
    chunks = PngImagePlugin.PngInfo()
    chunks.add(b"gAMA", (100_000).to_bytes(4, "big"))
    save(tmp_path, "left/0001.png", VIEWS[0].image, pnginfo=chunks)
    with pytest.raises(ExternalError, match=r"0001\.png says that its gamma is 1, sRGB's is 0\.45455"):
        read_external(settings(tmp_path), VIEWS)


def test_linear_light_is_told_from_srgb_by_the_photos(tmp_path: Path):
    photos = tuple(Photo(view.name, view.camera, encoded(view.image)) for view in VIEWS)
    for view in VIEWS:
        (tmp_path / "left").mkdir(exist_ok=True)
        np.save(tmp_path / f"{view.name[:-4]}.npy", view.image.numpy().transpose(1, 2, 0))
    with pytest.raises(ExternalError, match=r"with 100\.0 dB when taken for linear light: set external\.colors=linear"):
        read_external(settings(tmp_path), photos)
    found = read_external(settings(tmp_path, colors="linear"), photos)
    assert torch.equal(found.views["left/0001.jpg"]["image"], photos[0].image)
    assert found.notes == ("they hold linear light and were sRGB encoded",)
    kept = read_external(settings(tmp_path, colors="srgb"), photos).views["left/0001.jpg"]["image"]
    assert torch.equal(kept, VIEWS[0].image)


def test_one_picture_of_linear_light_among_others_is_named(tmp_path: Path):
    photos = tuple(Photo(view.name, view.camera, encoded(view.image)) for view in VIEWS)
    (tmp_path / "left").mkdir()
    for index, (view, photo) in enumerate(zip(VIEWS, photos, strict=True)):
        shown = photo.image if index else view.image
        np.save(tmp_path / f"{view.name[:-4]}.npy", shown.numpy().transpose(1, 2, 0))
    with pytest.raises(ExternalError, match=rf"{VIEWS[0].name} fit.* by more than 3 dB when taken for linear light"):
        read_external(settings(tmp_path), photos)
    read_external(settings(tmp_path, colors="srgb"), photos)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.full((HEIGHT, WIDTH, 3), 90.0), "holds values up to 90, colours lie in 0..1"),
        (np.full((HEIGHT, WIDTH, 3), np.nan), "holds NaN or inf"),
        (np.zeros((HEIGHT, WIDTH, 3), np.uint8), "type uint8: store floats"),
        (np.zeros((HEIGHT, WIDTH)), r"has shape \(8, 12\)"),
    ],
)
def test_arrays_that_are_no_colours_are_refused(tmp_path: Path, values: np.ndarray, message: str):
    complete(tmp_path)
    (tmp_path / "left" / "0001.png").unlink()
    np.save(tmp_path / "left" / "0001.npy", values)
    with pytest.raises(ExternalError, match=message):
        read_external(settings(tmp_path), VIEWS)


def test_transparent_pixels_are_refused_and_an_idle_alpha_is_not(tmp_path: Path):
    complete(tmp_path)
    alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
    Image.fromarray(np.concatenate([pixels(VIEWS[0].image), alpha], 2)).save(tmp_path / "left" / "0001.png")
    assert read_external(settings(tmp_path), VIEWS).views
    alpha[0, 0] = 100
    Image.fromarray(np.concatenate([pixels(VIEWS[0].image), alpha], 2)).save(tmp_path / "left" / "0001.png")
    with pytest.raises(ExternalError, match="has transparent pixels"):
        read_external(settings(tmp_path), VIEWS)


def test_layers_are_read_in_the_world_frame(tmp_path: Path):
    complete(tmp_path / "renders")
    layers = tmp_path / "layers"
    normal = torch.nn.functional.normalize(
        torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(3)), dim=0
    )
    for view in VIEWS:
        save(layers / "reflection", f"{view.name[:-4]}.png", view.image / 2)
        for name, values in (("depth", np.full((HEIGHT, WIDTH), 2.5)), ("normal", normal.numpy())):
            (layers / name / "left").mkdir(parents=True, exist_ok=True)
            np.save(layers / name / f"{view.name[:-4]}.npy", values)
    found = read_external(settings(tmp_path / "renders", layers=str(layers)), VIEWS).views["left/0002.jpg"]
    assert sorted(found) == ["depth", "image", "normal", "reflection"]
    torch.testing.assert_close(torch.einsum("ij,jhw->ihw", TURN, found["normal"]), normal)
    assert torch.equal(found["depth"], torch.full((HEIGHT, WIDTH), 2.5))
    (layers / "albedo").mkdir()
    with pytest.raises(
        ExternalError, match="has the folders albedo: known are reflection, transmission, depth, normal"
    ):
        read_external(settings(tmp_path / "renders", layers=str(layers)), VIEWS)
    (layers / "albedo").rmdir()
    (layers / "depth" / "left" / "0001.npy").unlink()
    with pytest.raises(ExternalError, match=r"external\.layers: depth=.* lacks 1 of 2 test views"):
        read_external(settings(tmp_path / "renders", layers=str(layers)), VIEWS)


@pytest.mark.parametrize("name", ["a,b", "two\nlines", "x" * 61])
def test_a_label_that_breaks_tables_is_refused(name: str):
    with pytest.raises(RtgsError, match=r"external\.name=.* must be printable, without a comma"):
        ExternalSettings(name=name)
