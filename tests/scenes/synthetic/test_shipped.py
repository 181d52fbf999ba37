"""Every shipped path-traced capture is what its description gives: one view again, small, in the scalar variant.

Apart from Monte-Carlo noise, which two independent halves tell, it may differ by how 256x192 pixels are averaged to
48x36, and by the files' quantisation.
"""

import numpy as np
import pytest

pytest.importorskip("mitsuba", reason="path tracing needs the extra 'synthetic'")

from rtgs.scenes.contact_sheet import synthetic_captures
from rtgs.scenes.images import area_resize, nearest_resize
from rtgs.scenes.synthetic.capture import description_digest
from rtgs.scenes.synthetic.description import named_scene
from rtgs.scenes.synthetic.record import CaptureRecord
from rtgs.scenes.synthetic.render import PathTracer
from rtgs.scenes.synthetic.variants import SCALAR_VARIANT
from rtgs.scenes.synthetic.viewpoints import cameras
from rtgs.scenes.truth import LAYERS, read_truth
from rtgs.scenes.truth_files import GLASS_MAPS
from tests.scenes.synthetic.test_glass_light import assert_parts_sum

WIDTH, HEIGHT, SAMPLES = 48, 36, 4
AVERAGING = 0.02  # root mean square in linear light: edges under two pixel grids, clipping before or after averaging
SHIFT = 0.02  # of a layer's mean


@pytest.mark.parametrize("folder", synthetic_captures(), ids=lambda folder: folder.name)
def test_a_view_rendered_again_is_the_shipped_one(folder):
    record, description = CaptureRecord.read(folder), named_scene(folder.name)
    assert record is not None
    assert record.description_sha256 == description_digest(description), "the scene changed after it was rendered"
    camera = cameras(description.viewpoints, record.width, record.height, record.seed)[0]
    truth = read_truth(folder / "truth" / camera.name)
    tracer = PathTracer(description, record.seed, SCALAR_VARIANT)
    small = camera.resized(WIDTH, HEIGHT)
    shapes = tracer.geometry(small).shape
    shipped_shapes = nearest_resize(truth.objects.numpy(), WIDTH, HEIGHT)
    assert (shapes == shipped_shapes).mean() > 0.97  # the rest are edges
    halves = [tracer.layers(small, SAMPLES, stream) for stream in (1, 2)]
    parts = [tracer.glass_light(small, SAMPLES, stream) for stream in (1, 2)] if description.transparent else []
    for layer in (*LAYERS, "image", *(GLASS_MAPS if parts else ())):
        first, second = (getattr(half, layer).clip(0, 1) for half in (parts if layer in GLASS_MAPS else halves))
        shipped = sum(getattr(truth, name) for name in (LAYERS if layer == "image" else (layer,)))
        expected = area_resize(np.ascontiguousarray(shipped.numpy().transpose(1, 2, 0)), WIDTH, HEIGHT)
        expected = expected.clip(0, 1)
        error, noise = (first + second) / 2 - expected, np.mean((first - second) ** 2) / 4
        assert np.mean(error**2) <= 1.5 * noise + AVERAGING**2, layer
        assert abs(error.mean()) <= SHIFT * expected.mean() + 3 * np.sqrt(noise / len(error)), layer


@pytest.mark.parametrize("folder", synthetic_captures(), ids=lambda folder: folder.name)
def test_parts_of_the_light_through_glass_sum_to_it(folder):
    transparent = bool(named_scene(folder.name).transparent)
    for truth in sorted((folder / "truth").iterdir()):
        assert (read_truth(truth).inner is not None) == transparent, truth
        if transparent:
            assert_parts_sum(truth)


def test_the_shipped_set_stays_small():
    size = sum(file.stat().st_size for folder in synthetic_captures() for file in folder.rglob("*") if file.is_file())
    assert len(synthetic_captures()) == 9
    assert size <= 32e6, "make the capture again, or smaller: it is part of every clone"


@pytest.mark.parametrize("folder", synthetic_captures(), ids=lambda folder: folder.name)
def test_test_images_are_close_to_converged(folder):
    record = CaptureRecord.read(folder)
    assert record is not None
    assert record.noise_psnr_worst >= 38
