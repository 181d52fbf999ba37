"""The truth of a view: written, read, shrunk, carried by the importer and the cached scene."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from PIL import Image

from rtgs.scenes.canonical import read_scene, save_scene
from rtgs.scenes.digest import capture_digest
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.truth import (
    LAYERS,
    ViewTruth,
    linear_from_srgb,
    read_light,
    read_truth,
    srgb_from_linear,
    write_truth,
)
from rtgs.scenes.truth_files import GLASS_MAPS, TRUTH_MAPS, glass_files, truth_files

SIZE = (24, 32)


def drawn_truth(
    seed: int = 0, size: tuple[int, int] = SIZE, brightest: float = 0.9, *, parts: bool = False
) -> ViewTruth:
    """``parts``: with those of the transmitted light."""
    generator = torch.Generator().manual_seed(seed)
    height, width = size

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    known = uniform(height, width) > 0.1
    depth = (0.5 + 5 * uniform(height, width)) * known
    normal = torch.nn.functional.normalize(uniform(3, height, width) - 0.5, dim=0) * known
    objects = torch.where(known, (uniform(height, width) * 20).short(), torch.tensor(-1, dtype=torch.int16))
    lights = {name: brightest * uniform(3, height, width) ** 2 for name in LAYERS}
    specular = (uniform(height, width) > 0.5) & known
    if parts:
        shares = torch.nn.functional.normalize(uniform(3, 1, height, width), p=1, dim=0)
        lights |= dict(zip(GLASS_MAPS, shares * lights["transmitted"]))
    return ViewTruth(depth, depth * 1.3, normal, objects, specular, **lights)


def test_every_map_of_a_view_has_its_file(tmp_path):
    assert tuple(field.name for field in fields(ViewTruth)) == TRUTH_MAPS + GLASS_MAPS
    for parts, maps in ((False, TRUTH_MAPS), (True, TRUTH_MAPS + GLASS_MAPS)):
        folder = tmp_path / str(parts)
        write_truth(folder, drawn_truth(parts=parts))
        assert {*truth_files(folder)} == {*folder.iterdir()} == {folder / f"{name}.png" for name in maps}


@pytest.mark.parametrize("parts", [False, True])
def test_what_is_read_is_what_was_written_within_the_documented_error(tmp_path, parts):
    truth = drawn_truth(parts=parts)
    write_truth(tmp_path, truth)
    read = read_truth(tmp_path)
    assert read.tensors().keys() == truth.tensors().keys()
    for name, tensor in truth.tensors().items():
        assert read.tensors()[name].dtype == tensor.dtype, name
        assert read.tensors()[name].shape == tensor.shape, name
    for name in ("depth", "second_depth"):
        written, found = getattr(truth, name), getattr(read, name)
        assert (written - found).abs().max() <= written.max() / 16382 * 1.01
        assert ((written == 0) == (found == 0)).all()
    assert (read.objects == truth.objects).all()
    assert (read.specular == truth.specular).all()
    known = truth.objects >= 0
    cosine = (truth.normal * read.normal).sum(0)[known].clamp(max=1)
    assert torch.rad2deg(torch.arccos(cosine)).max() < 0.4
    assert (read.normal[:, ~known] == 0).all()
    for name in (*LAYERS, *(GLASS_MAPS if parts else ())):
        encoded = [srgb_from_linear(getattr(view, name).numpy()) for view in (truth, read)]
        assert np.abs(encoded[0] - encoded[1]).max() <= 0.5 / 255 + 1e-6


def test_bright_light_keeps_its_scale_and_sparks_are_clipped(tmp_path):
    truth = drawn_truth(size=(64, 64), brightest=6.0)
    truth.reflected[:, 3, 4] = 500.0
    write_truth(tmp_path, truth)
    read = read_truth(tmp_path)
    assert float(read.reflected[:, 3, 4].max()) == pytest.approx(8.0)
    ordinary = truth.reflected < 6.0
    error = (truth.reflected - read.reflected)[ordinary].abs()
    assert error.max() < 8 * 2.4 * 1.1 / 510  # slope of the inverse curve at 1, half a step


def test_parts_of_the_transmitted_light_are_not_clipped(tmp_path):
    truth = drawn_truth(size=(64, 64), parts=True)
    assert truth.inner is not None
    truth.inner[:, 3, 4] = 6.0
    write_truth(tmp_path, truth)
    assert torch.equal(read_light(tmp_path, "inner"), read_truth(tmp_path).inner)  # type: ignore[arg-type]
    assert float(read_light(tmp_path, "inner")[:, 3, 4].min()) == pytest.approx(6.0, rel=0.01)


def test_some_parts_of_the_transmitted_light_alone_are_not_written(tmp_path):
    with pytest.raises(ValueError, match=r"would hold inner, behind only: write all of inner, contents, behind"):
        write_truth(tmp_path, replace(drawn_truth(parts=True), contents=None))


def test_the_curve_and_its_inverse():
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(values)), values, atol=1e-6)
    assert srgb_from_linear(np.array([0.2158605])) == pytest.approx(128 / 255, abs=1e-3)
    np.testing.assert_allclose(srgb_from_linear(np.array([-1.0, 4.0])), [0.0, 1.0], atol=1e-12)


def test_shrinking_averages_light_and_picks_geometry():
    truth = drawn_truth(parts=True)
    small = truth.resized(16, 12)
    for name in GLASS_MAPS:
        averaged = torch.nn.functional.avg_pool2d(truth.tensors()[name], 2)
        torch.testing.assert_close(small.tensors()[name], averaged, atol=1e-6, rtol=1e-5)
    assert drawn_truth().resized(16, 12).inner is None
    assert small.depth.shape == (12, 16)
    assert small.normal.shape == (3, 12, 16)
    torch.testing.assert_close(
        small.reflected, torch.nn.functional.avg_pool2d(truth.reflected, 2), atol=1e-6, rtol=1e-5
    )
    assert set(small.depth.unique().tolist()) <= set(truth.depth.unique().tolist())
    torch.testing.assert_close(small.depth, truth.depth[1::2, 1::2])
    assert (small.objects == truth.objects[1::2, 1::2]).all()
    assert truth.resized(32, 24) is truth


@pytest.fixture
def capture(tmp_path):
    """Nine photos with poses; truth of the first and the last, which are the test views."""
    folder = tmp_path / "capture"
    (folder / "images").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "sparse" / "0" / "cameras.txt").write_text("1 PINHOLE 32 24 30.0 30.0 16.0 12.0\n")
    lines, rng = [], np.random.default_rng(0)
    for index in range(9):
        x = 0.3 * index
        lines.append(f"{index + 1} 1 0 0 0 {-x} 0 0 1 view_{index}.png\n\n")
        Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(folder / f"images/view_{index}.png")
    (folder / "sparse" / "0" / "images.txt").write_text("".join(lines))
    points = "".join(f"{i + 1} {0.1 * i} {0.05 * (i % 7)} {2 + 0.1 * (i % 5)} 9 9 9 0.5\n" for i in range(40))
    (folder / "sparse" / "0" / "points3D.txt").write_text(points)
    for index in (0, 8):
        write_truth(folder / "truth" / f"view_{index}", drawn_truth(index, parts=index == 8))
    return folder


def test_the_importer_carries_the_truth_of_test_views_and_the_cache_keeps_it(capture, tmp_path):
    scene = load_scene(SceneSettings(path=str(capture), long_side=16))
    assert [view.name for view in scene.test] == ["view_0.png", "view_8.png"]
    assert all(view.truth is None for view in scene.train)
    save_scene(scene, tmp_path / "canonical")
    for index, name in enumerate(("view_0", "view_8")):
        expected = read_truth(capture / "truth" / name).resized(16, 12)
        for found in (scene.test[index].truth, read_scene(tmp_path / "canonical").test[index].truth):
            assert found is not None
            assert found.tensors().keys() == expected.tensors().keys()
            for kind, tensor in expected.tensors().items():
                assert torch.equal(found.tensors()[kind], tensor), kind


def test_the_digest_knows_the_truth(capture):
    settings = SceneSettings(path=str(capture))
    before = capture_digest(settings)
    Image.fromarray(np.zeros((24, 32), np.uint8)).save(capture / "truth" / "view_0" / "objects.png")
    assert capture_digest(settings) != before


def test_the_digest_is_that_of_before_until_the_parts_of_the_transmitted_light_are_there(capture):
    settings = SceneSettings(path=str(capture))
    parts = [part.read_bytes() for part in glass_files(capture / "truth" / "view_8")]
    full = capture_digest(settings)
    for part in glass_files(capture / "truth" / "view_8"):
        part.unlink()
    without = capture_digest(settings)
    assert without != full
    (capture / "truth" / "view_8" / "notes.txt").write_text("not read, not counted")
    assert capture_digest(settings) == without
    for part, content in zip(glass_files(capture / "truth" / "view_8"), parts, strict=True):
        part.write_bytes(content)
    assert capture_digest(settings) == full


def test_bad_truth_is_refused_with_its_name(capture):
    settings = SceneSettings(path=str(capture))
    write_truth(capture / "truth" / "view_0", drawn_truth(0, (12, 16)))
    with pytest.raises(CaptureError, match=r"truth .*view_0 is of a 16x12 .*32x24"):
        load_scene(settings)
    write_truth(capture / "truth" / "view_0", drawn_truth(0))
    Image.fromarray(np.zeros((5, 5), np.uint16)).save(capture / "truth" / "view_0" / "depth.png")
    with pytest.raises(CaptureError, match="pictures of the sizes"):
        load_scene(settings)
    Image.fromarray(np.zeros((24, 32), np.uint16)).save(capture / "truth" / "view_0" / "depth.png")
    with pytest.raises(CaptureError, match=r"depth.png has no scale"):
        load_scene(settings)
    (capture / "truth" / "view_0" / "depth.png").write_bytes(b"no picture")
    with pytest.raises(CaptureError, match=r"depth.png cannot be read"):
        load_scene(settings)
    (capture / "truth" / "view_0" / "depth.png").unlink()
    with pytest.raises(CaptureError, match=r"1 of 19 truth pictures do not exist"):
        load_scene(settings)


@pytest.mark.parametrize("name", GLASS_MAPS)
def test_bad_parts_of_the_transmitted_light_are_refused_like_other_truth(capture, name):
    settings = SceneSettings(path=str(capture))
    part = capture / "truth" / "view_8" / f"{name}.png"
    good = part.read_bytes()
    for size, problem in (((24, 32, 3), "has no scale"), ((24, 32), "is no colour picture")):
        Image.fromarray(np.zeros(size, np.uint8)).save(part)
        with pytest.raises(CaptureError, match=rf"{name}.png {problem}"):
            load_scene(settings)
    Image.fromarray(np.zeros((5, 5, 3), np.uint8)).save(part)
    with pytest.raises(CaptureError, match="pictures of the sizes"):
        load_scene(settings)
    part.write_bytes(good[:-40])
    with pytest.raises(CaptureError, match=rf"{name}.png cannot be read"):
        load_scene(settings)
    part.unlink()
    with pytest.raises(CaptureError, match=r"1 of 19 truth pictures do not exist"):
        load_scene(settings)


def test_more_shapes_than_the_format_tells_apart_are_refused(tmp_path):
    truth = drawn_truth()
    many = replace(truth, objects=torch.full_like(truth.objects, 300))
    with pytest.raises(ValueError, match="shape id 300"):
        write_truth(tmp_path, many)
