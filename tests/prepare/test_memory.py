"""No step of the preparation holds all photos: those in memory at once are counted, however many there are."""

from __future__ import annotations

import weakref
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
pytest.importorskip("tokenizers")

from rtgs.prepare.masks import make as masks
from rtgs.prepare.masks import maker, makers, networks
from rtgs.prepare.masks.make import MaskRequest, make_masks
from rtgs.prepare.masks.settings import DetectorSettings, GivenSettings, MaskSettings
from rtgs.prepare.normals import make as normals
from rtgs.prepare.normals.make import make_normals
from rtgs.prepare.poses import export, photos
from rtgs.prepare.poses.photos import lay_out, read_photo_set, write_ignored
from rtgs.prepare.settings import NormalSettings
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.undistort import Lens
from tests.prepare import glass_scene, tiny_networks
from tests.prepare.glass_scene import shots, write_capture
from tests.prepare.masks.test_run import CLEAN, box_around, marks
from tests.prepare.room import write_normal_capture

SHOTS = shots(8)


class Counter:
    """Wraps functions that return pixels of a whole photo; counts how many of those arrays live at once."""

    def __init__(self) -> None:
        self.alive = self.most = self.calls = 0

    def wrapped(self, function):
        def counted(*arguments, **named):
            pixels = function(*arguments, **named)
            self.alive, self.calls = self.alive + 1, self.calls + 1
            self.most = max(self.most, self.alive)
            weakref.finalize(pixels, self._gone)
            return pixels

        return counted

    def _gone(self) -> None:
        self.alive -= 1


@pytest.fixture
def counter(monkeypatch) -> Counter:
    """Every function by which the preparation reads photos, masks and normal maps."""
    count = Counter()
    readers = ("read_photo", "read_mask", "read_normals", "fitted_mask", "read_given")
    for module in (masks, maker, makers, networks, normals, photos, export):
        for name in readers:
            if hasattr(module, name):
                monkeypatch.setattr(module, name, count.wrapped(getattr(module, name)))
    return count


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    root = write_capture(tmp_path_factory.mktemp("glass") / "ball", SHOTS)
    marks(root, cutouts={SHOTS[index].name: {"box": box_around(SHOTS[index].mask)} for index in (0, 4, 7)})
    glass_scene.write_masks(root / "painted", {f"{shot.name}.png": shot.mask for shot in SHOTS})
    return root


@pytest.mark.parametrize("method", ["grounded_sam2", "grabcut", "given"])
def test_masks_hold_a_photo_and_two_masks(method, capture, counter, tmp_path, monkeypatch):
    monkeypatch.setenv("RTGS_WEIGHTS", str(tmp_path / "weights"))
    glass_scene.write_networks(tmp_path / "weights")
    detector = DetectorSettings(prompt="glass", short_side=160, long_side=240)
    settings = MaskSettings(clean=CLEAN, detector=detector, given=GivenSettings(folder="painted"))
    scene = SceneSettings(path=str(capture), masks_dir="")
    (tmp_path / "out").mkdir()
    report = make_masks(
        MaskRequest(method, scene, settings, capture, tmp_path / "cache", 1), tmp_path / "out", lambda _: None
    )
    assert report.masks == len(SHOTS)
    assert counter.calls >= 2 * len(SHOTS)
    assert counter.most <= 3, "a photo, its mask, the mask before"


def test_normals_hold_one_photo(counter, tmp_path):
    settings = NormalSettings(model="custom", file=str(tmp_path / "net.onnx"))
    tiny_networks.color_reader(tmp_path / "net.onnx", settings.declared)
    (tmp_path / "out").mkdir()
    scene = SceneSettings(path=str(write_normal_capture(tmp_path / "room", count=6)))
    make_normals(scene, settings, tmp_path / "cache", tmp_path / "out", 1, lambda _: None)
    assert counter.calls == 6
    assert counter.most == 1


def test_the_search_for_poses_lays_out_and_masks_photo_by_photo(counter, tmp_path):
    """COLMAP reads photos itself, one in each thread."""
    for index, shot in enumerate(SHOTS):
        picture = Image.fromarray(np.dstack([shot.pixels, np.full(shot.mask.shape, 255, dtype=np.uint8)]))
        (tmp_path / "images").mkdir(exist_ok=True)
        picture.save(tmp_path / f"images/{index}.png")  # with alpha: read and written anew
    glass_scene.write_masks(tmp_path / "masks", {f"{index}.png": shot.mask for index, shot in enumerate(SHOTS)})
    found = read_photo_set(tmp_path)
    lay_out(found, tmp_path / "out", (0.0, 0.0, 0.0), lambda _: None)
    assert (counter.calls, counter.most) == (len(SHOTS), 1)
    assert write_ignored(found, [tmp_path / "masks"], tmp_path / "ignored") == len(SHOTS)
    lens = Lens("PINHOLE", 160, 120, (150.0, 150.0, 80.0, 60.0))
    assert export.carry_masks(found, dict.fromkeys(found.names, lens), tmp_path / "masks", tmp_path / "kept") == 8
    assert counter.calls > 2 * len(SHOTS)
    assert counter.most <= 4, "a mask as it is read and as it fits the photo, and those before"
