"""Layers as pixels, side by side, and as films."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.evaluate.layers import added_by_base
from rtgs.report.films import write_mp4, write_preview
from rtgs.report.shown import SHOWN, DepthRange, choose_layers, layers_of, shown_layer, side_by_side

HEIGHT, WIDTH = 6, 8
CAMERA = Camera(torch.eye(3), torch.zeros(3), 8.0, 8.0, 4.0, 3.0, WIDTH, HEIGHT)


def maps(**more: torch.Tensor) -> dict[str, torch.Tensor]:
    plane, colour = torch.full((HEIGHT, WIDTH), 0.5), torch.full((3, HEIGHT, WIDTH), 0.4)
    return {
        "image": colour,
        "diffuse": colour,
        "reflection": 0.5 * colour,
        "transmission": 0.25 * colour,
        "specular": 0.5 * plane,
        "normal": torch.nn.functional.normalize(torch.ones(3, HEIGHT, WIDTH), dim=0),
        "depth": torch.linspace(1, 3, WIDTH).expand(HEIGHT, WIDTH),
        "alpha": torch.ones(HEIGHT, WIDTH),
        "reflection_weight": plane,
        "transmission_weight": 0.2 * plane,
    } | more


def test_every_layer_is_what_its_name_says():
    found = {name: shown_layer(name, maps(), CAMERA, None) for name in SHOWN}
    assert {picture.shape for picture in found.values()} == {(HEIGHT, WIDTH, 3)}
    assert {picture.dtype for picture in found.values()} == {np.dtype(np.uint8)}
    value = {name: tuple(picture[0, 0]) for name, picture in found.items()}
    assert value["final"] == (102, 102, 102)
    assert value["diffuse"] == tuple([round(255 * 0.75 * 0.4)] * 3)
    assert value["reflection"] == (51, 51, 51)
    assert np.abs(np.subtract(value["transmission"], 25.5)).max() <= 0.5
    assert np.abs(np.subtract(value["weights"], (127.5, 191.25, 25.5))).max() <= 0.5


def test_pixels_that_were_not_traced_show_the_base_set_alone():
    traced = torch.ones(HEIGHT, WIDTH)
    traced[0, 1] = 0
    diffuse, weights = (shown_layer(name, maps(traced=traced), CAMERA, None) for name in ("diffuse", "weights"))
    assert [tuple(diffuse[0, column]) for column in (0, 1)] == [(76, 76, 76), (102, 102, 102)]
    assert [int(weights[0, column, 1]) for column in (0, 1)] == [191, 255]


def test_depth_keeps_its_colours_from_frame_to_frame():
    near, far = maps(), maps(depth=maps()["depth"] + 2)
    depths = DepthRange.of([near, far])
    assert depths is not None
    assert 0.9 < depths.near < 1.3
    assert 4.7 < depths.far < 5.1
    at_three = (shown_layer("depth", near, CAMERA, depths)[0, -1], shown_layer("depth", far, CAMERA, depths)[0, 0])
    assert at_three[0].tolist() == at_three[1].tolist()
    empty = maps(alpha=torch.zeros(HEIGHT, WIDTH))
    assert DepthRange.of([empty]) is None
    assert (shown_layer("depth", empty, CAMERA, None) == 128).all()


def test_a_model_has_the_layers_of_its_maps():
    plain = {name: maps()[name] for name in ("image", "depth", "alpha", "normal")}
    assert layers_of(plain) == ("final", "normal", "depth")
    assert layers_of(maps()) == SHOWN
    assert choose_layers(["all"], layers_of(plain), "2dgs") == ("final", "normal", "depth")
    with pytest.raises(RtgsError, match="layer=reflection: method 2dgs has none in this model; it has final"):
        choose_layers(["reflection"], layers_of(plain), "2dgs")
    with pytest.raises(RtgsError, match="layer=mirror is unknown: choose some of final, diffuse"):
        choose_layers(["final", "mirror"], SHOWN, "rtgs")


def test_several_layers_stand_beside_each_other():
    pictures = {name: shown_layer(name, maps(), CAMERA, None) for name in SHOWN}
    assert side_by_side({"final": pictures["final"]}) is pictures["final"]
    page = side_by_side(pictures)
    assert page.shape[0] > 2 * HEIGHT
    assert page.shape[1] > 2 * WIDTH
    rows = np.flatnonzero((page[:, :WIDTH] == pictures["final"][0, 0]).all(axis=(1, 2)))
    assert len(rows) >= HEIGHT


def frames(count: int, height: int = 21, width: int = 33) -> list[np.ndarray]:
    ramp = np.linspace(0, 255, width, dtype=np.float64)
    return [np.stack([np.roll(ramp, 3 * k)] * height).astype(np.uint8)[..., None].repeat(3, 2) for k in range(count)]


def test_a_preview_plays_for_ever_and_fits(tmp_path):
    made = frames(6)
    size = write_preview(tmp_path / "a.webp", made, 10)
    assert size == (tmp_path / "a.webp").stat().st_size
    with Image.open(tmp_path / "a.webp") as opened:
        assert (opened.n_frames, opened.size, opened.info["loop"]) == (6, (33, 21), 0)  # type: ignore[attr-defined]
        opened.seek(3)
        shown = np.asarray(opened.convert("RGB")).astype(int)
    assert np.abs(shown - made[3]).mean() < 12
    noise = [np.random.default_rng(k).integers(0, 255, (300, 400, 3), np.uint8) for k in range(3)]
    large = write_preview(tmp_path / "b.webp", noise, 10, most=10**9)
    assert write_preview(tmp_path / "c.webp", noise, 10, most=large - 1) < large
    with pytest.raises(ValueError, match="at least one frame"):
        write_preview(tmp_path / "d.webp", [], 10)


def test_a_film_has_the_frames_and_even_sides(tmp_path):
    av = pytest.importorskip("av", reason="pip install av")
    made = frames(5)
    write_mp4(tmp_path / "a.mp4", iter(made), 12)
    with av.open(str(tmp_path / "a.mp4")) as opened:
        stream = opened.streams.video[0]
        assert (stream.width, stream.height, stream.average_rate) == (34, 22, 12)
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        shown = [frame.to_ndarray(format="rgb24")[:21, :33].astype(int) for frame in opened.decode(stream)]
    assert len(shown) == 5
    assert max(np.abs(picture - frame).mean() for picture, frame in zip(shown, made)) < 8


def test_what_the_base_set_adds_where_the_reflection_takes_nothing_from_it():
    maps = {"diffuse": torch.full((3, 2, 2), 0.5), "specular": torch.full((2, 2), 0.8)}
    torch.testing.assert_close(added_by_base(maps), torch.full((3, 2, 2), 0.1))
    base = torch.rand(3, 2, 2)
    assert torch.equal(added_by_base({**maps, "base": base}), base)
