"""Panels: what a tile shows, where its crops lie, and files that are the same whenever they are written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib import colormaps
from PIL import Image

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.evaluate.curves import Look, QualityCurve
from rtgs.report.panels import LAYERS, Box, PanelRow, Tile, draw_panels, layer_pixels, lines_of
from rtgs.report.time_quality import draw_time_quality

SIZE = (12, 16)
CAMERA = Camera(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), 14.0, 14.0, 8.0, 6.0, 16, 12)
PHOTO = torch.rand((3, *SIZE), generator=torch.Generator().manual_seed(0))


def maps() -> dict[str, torch.Tensor]:
    color, flat = torch.full((3, *SIZE), 0.5), torch.full(SIZE, 0.25)
    normal = torch.zeros(3, *SIZE)
    normal[2] = -1
    lights = {"reflection": color / 4, "reflected_color": color, "transmission": color / 2, "transmitted_color": color}
    lights["environment"] = color
    rest = {"inner": color, "contents": color, "behind": color, "normal": normal, "depth": 1 + torch.rand(SIZE)}
    return {"image": PHOTO, "diffuse": color, "specular": flat, "roughness": flat, "f0": flat} | lights | rest


def test_every_layer_is_a_picture_and_absent_ones_are_none():
    for layer in LAYERS:
        pixels = layer_pixels(layer, maps(), PHOTO, CAMERA, "srgb")
        assert pixels is not None, layer
        assert (pixels.shape, pixels.dtype) == ((*SIZE, 3), np.uint8)
    absent = {layer for layer in LAYERS if layer_pixels(layer, {"image": PHOTO}, PHOTO, CAMERA, "srgb") is None}
    assert absent == set(LAYERS) - {"photo", "image", "error"}
    with pytest.raises(RtgsError, match=r"layer='normals' is unknown.*did you mean 'normal'"):
        layer_pixels("normals", maps(), PHOTO, CAMERA, "srgb")


def test_a_weight_is_a_share_of_light_in_the_blend_of_the_run():
    shown = {blend: layer_pixels("reflected_weight", maps(), PHOTO, CAMERA, blend) for blend in ("srgb", "linear")}
    assert shown["srgb"] is not None
    assert shown["linear"] is not None
    assert int(shown["srgb"][0, 0, 0]) == 64  # a quarter
    light = [((value + 0.055) / 1.055) ** 2.4 for value in (0.125, 0.5)]
    assert int(shown["linear"][0, 0, 0]) == round(255 * light[0] / light[1])
    dark = maps() | {"reflected_color": torch.zeros(3, *SIZE)}
    nothing = layer_pixels("reflected_weight", dark, PHOTO, CAMERA, "srgb")
    assert nothing is not None
    assert not nothing.any()


@pytest.mark.parametrize("box", [(0.6, 0.1, 0.5, 0.2), (-0.1, 0, 0.5, 0.5), (0, 0, 0, 0.5)])
def test_a_crop_outside_the_picture_is_refused(box):
    with pytest.raises(RtgsError, match=r"crops=.*inside it"):
        Box(*box)


def test_a_crop_has_at_least_a_pixel():
    assert Box(0.5, 0.25, 0.25, 0.5).pixels(12, 16) == (slice(3, 9), slice(8, 12))
    rows, columns = Box(0.99, 0.99, 0.001, 0.001).pixels(12, 16)
    assert (rows, columns) == (slice(11, 12), slice(15, 16))


def test_panels_are_drawn_with_frames_and_crops_to_the_same_bytes(tmp_path: Path):
    grey = np.full((*SIZE, 3), 128, np.uint8)
    tiles = tuple(Tile(grey, f"method {k}\n2{k}.00 dB") for k in range(2))
    rows = [PanelRow("sedan\na.png", tiles, (Box(0.1, 0.1, 0.3, 0.3), Box(0.5, 0.5, 0.4, 0.4))), PanelRow("b", tiles)]
    first = draw_panels(rows, "A caption. " * 8, tmp_path / "one" / "figure")
    second = draw_panels(rows, "A caption. " * 8, tmp_path / "two" / "figure")
    assert [path.name for path in first] == ["figure.png", "figure.pdf"]
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]
    assert first[1].read_bytes()[:5] == b"%PDF-"
    colors = {tuple(color) for color in np.asarray(Image.open(first[0]).convert("RGB")).reshape(-1, 3)}
    assert {(128, 128, 128), (0xE6, 0x19, 0x4B), (0x3C, 0xB4, 0x4B)} <= colors
    with pytest.raises(RtgsError, match=r"its rows have \[1, 2\] tiles"):
        draw_panels([rows[0], PanelRow("c", tiles[:1])], "", tmp_path / "three")


def test_many_columns_stand_in_lines_that_are_about_as_long():
    assert [lines_of(count) for count in (1, 5, 6, 7, 9, 10, 12, 13)] == [
        *((1, 1), (1, 5), (1, 6), (2, 4), (2, 5), (2, 5), (2, 6), (3, 5))
    ]


def test_what_does_not_fit_beside_goes_below_and_crops_are_of_pictures_like_the_first(tmp_path: Path):
    grey, panorama = np.full((*SIZE, 3), 128, np.uint8), np.full((8, 16, 3), 200, np.uint8)
    crops = (Box(0.1, 0.1, 0.3, 0.3),)
    sizes = []
    for count in (5, 6, 9):
        tiles = (*(Tile(grey, f"method {k}") for k in range(count - 1)), Tile(panorama, "far light"))
        picture, _ = draw_panels([PanelRow("sedan", tiles, crops)], "A caption.", tmp_path / str(count))
        pixels = np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3)
        frames = int((pixels == (0xE6, 0x19, 0x4B)).all(1).sum())
        sizes.append((Image.open(picture).size, frames))
    (five, few), (six, more), (nine, most) = sizes
    assert nine[0] == five[0] < six[0]  # five beside each other
    assert five[1] == six[1] < 0.6 * nine[1]
    assert few < more < most
    alone, _ = draw_panels([PanelRow("a", (Tile(grey), Tile(panorama)))], "", tmp_path / "alone")
    assert (200, 200, 200) in {tuple(color) for color in np.asarray(Image.open(alone).convert("RGB")).reshape(-1, 3)}


def test_curves_of_a_scene_are_drawn_with_their_masks(tmp_path: Path):
    looks = tuple(Look(k, float(k), 20 + k**0.5, 15 + k**0.5) for k in (1, 4, 9, 25))
    curves = [QualityCurve("sedan", method, "quick", 0, looks) for method in ("3dgs", "rtgs")]
    plain = [QualityCurve("sedan", "3dgs", "quick", 0, tuple(Look(k.steps, k.cpu_seconds, k.psnr) for k in looks))]
    both, alone = draw_time_quality(curves, tmp_path / "both"), draw_time_quality(plain, tmp_path / "alone")
    assert [path.suffix for path in both] == [".png", ".pdf"]
    assert Image.open(both[0]).width > 1.4 * Image.open(alone[0]).width  # a second plot, of the masks


def test_ten_methods_have_ten_colours(tmp_path: Path):
    looks = tuple(Look(k, float(k), 20 + k**0.5) for k in (1, 4, 9, 25))
    found = []
    for count in (1, 10):
        curves = [QualityCurve("sedan", f"method{each}", "quick", 0, looks) for each in range(count)]
        picture, _ = draw_time_quality(curves, tmp_path / str(count))
        pixels = np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3)
        found.append({tuple(color) for color in np.unique(pixels, axis=0).tolist()})
    tab10 = {tuple(round(255 * part) for part in color) for color in colormaps["tab10"].colors}  # type: ignore[attr-defined]
    vivid = {color for color in tab10 if len(set(color)) > 1}  # its grey is in letters as well
    assert len(vivid) == 9
    assert len(found[0] & vivid) == 1
    assert found[1] >= vivid, "the legend's lines at least"
