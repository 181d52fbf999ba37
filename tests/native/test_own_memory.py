"""The core writes into the caller's arrays or refuses them: what it wrote into a converted copy nobody would see."""

from collections.abc import Callable

import numpy as np
import pytest

from rtgs.native import core
from tests.render.native_scene import native_scene
from tests.render.native_trace_scene import native_trace_scene

_PIXELS, _SIDES = 6, np.array([2], np.int32)
_CORNERS = np.zeros((0, 4), np.int32)


def _floats(*shape: int) -> np.ndarray:
    return np.full(shape, 0.5, np.float32)


def _rasterise(image: np.ndarray) -> None:
    scene = native_scene(count=3, width=16, height=16, channels=3)
    rotation, translation = scene.camera.rotation.numpy(), scene.camera.translation.numpy()
    camera = core.RasterCamera(rotation, translation, 10, 10, 8, 8, 16, 16, 0.2, 100)
    native = core.Rasterization(camera, False, False)
    native.project(*(tensor.numpy() for tensor in scene.tensors), 1)
    native.forward(_floats(3), image, None, _floats(16, 16), None, None, None, None)


def _ellipsoids(image: np.ndarray) -> None:
    scene = native_scene(count=3, width=16, height=16, channels=3)
    rotation, translation = scene.camera.rotation.numpy(), scene.camera.translation.numpy()
    camera = core.RasterCamera(rotation, translation, 10, 10, 8, 8, 16, 16, 0.2, 100)
    native = core.EllipsoidRasterization(camera, 0.3, 3.0, False, False)
    arrays = [tensor.numpy() for tensor in scene.tensors]
    arrays[3] = _floats(3, 3)
    native.project(*arrays, 1)
    native.forward(_floats(3), image, _floats(16, 16), None, None)


def _trace(alpha: np.ndarray) -> None:
    scene = native_trace_scene(count=20, rays=_PIXELS)
    surfels = [tensor.numpy() for tensor in scene.all()[:5]]
    tree = core.SurfelTree()
    tree.build(*surfels, 1 / 255, 1)
    rays = (np.zeros((_PIXELS, 3), np.float32), np.tile(np.array([0, 0, 1], np.float32), (_PIXELS, 1)))
    tracing = core.Tracing(1e-4, 1 / 255, 0, False, False, "given", 1)
    tracing.forward(
        tree, *surfels, None, None, None, *rays, None, None, 0.0, 9.0, False, None, None, alpha, *[None] * 3
    )


def _activate(colors: np.ndarray) -> None:
    raw = (_floats(2, 3), _floats(2, 2), _floats(2, 4), _floats(2), _floats(2, 3), _floats(2, 15, 3))
    out = (_floats(2, 3), _floats(2, 3), _floats(2, 2), _floats(2), colors)
    core.activate_gaussians(raw, (0.0, 0.0, 0.0), 0, out, None, 1)


def _photometric(gradient: np.ndarray) -> None:
    core.photometric_loss(_floats(3, 8, 8), _floats(3, 8, 8) + 1, 1.0, 0.0, False, gradient, None, 1)


def _adam(values: np.ndarray) -> None:
    core.adam_step([(values, *(_floats(4, 2) for _ in range(3)), 2, 0.1)], 0.9, 0.99, 1e-8, 1.0, 1)


def _normal(gradient: np.ndarray) -> None:
    rotation = np.eye(3, dtype=np.float32)
    core.mono_normal_loss(_floats(3, 8, 8), -_floats(3, 8, 8), None, rotation, 1.0, gradient, 1)


def _mirror(cosine: np.ndarray) -> None:
    maps = _floats(4, 3), _floats(4), _floats(4, 3)
    core.mirror_rays(*maps, (0.0, 0.0, 0.0), 1e-6, False, None, _floats(4, 3), _floats(4, 3), cosine, 1)


def _microfacet(weight: np.ndarray) -> None:
    core.microfacet_reflection(*(_floats(4) for _ in range(3)), 1e-3, 1e-3, 1.0, weight, 1)


def _lobes(weight: np.ndarray) -> None:
    core.lobe_weight(_floats(4), _floats(4), _floats(3, 4), _floats(2, 2, 2), 2, 1.0, 1e-3, weight, 1)


def _mean_mirror(cosine: np.ndarray) -> None:
    core.mean_mirror(_floats(3, 4), _floats(4), _floats(3, 4), False, 1e-6, 1e-6, _floats(4, 3), cosine, 1)


def _mirror_light(color: np.ndarray) -> None:
    rows = [_floats(4, 3) for _ in range(3)]
    core.mirror_light(*rows, (0.0, 0.0, 0.0), _floats(4, 3), _floats(4, 45), color, 1)


def _light(color: np.ndarray) -> None:
    core.cube_lookup(_floats(6 * 16, 4), _SIDES, _floats(_PIXELS, 3), _floats(0), color, 1)


def _padded(padded: np.ndarray) -> None:
    core.cube_pad(np.zeros(5, np.int32), _CORNERS, _floats(3, 3) / 3, padded)


def _features(color: np.ndarray) -> None:
    network = [(16, 80), (16, 16), (8, 16), (80, 16), (16, 16), (16, 16), (16,), (16,), (16,)]
    given = (np.array([4, 2], np.int32), tuple(_floats(*shape) for shape in network), _floats(_PIXELS, 3))
    more = (_floats(_PIXELS), _floats(_PIXELS, 4), _floats(core.feature_scratch(16)))
    core.feature_light(_floats(40, 16), *given, *more, _floats(_PIXELS, 16), _floats(_PIXELS, 2), color, 1)


# The call, and the shape of the array that it fills.
OUTPUTS: dict[str, tuple[Callable[[np.ndarray], None], tuple[int, ...]]] = {
    "raster": (_rasterise, (3, 16, 16)),
    "ellipsoids": (_ellipsoids, (3, 16, 16)),
    "trace": (_trace, (_PIXELS, 1)),
    "activate": (_activate, (2, 3)),
    "photometric": (_photometric, (3, 8, 8)),
    "adam": (_adam, (4, 2)),
    "mono normal": (_normal, (3, 8, 8)),
    "mirror": (_mirror, (4,)),
    "microfacet": (_microfacet, (4,)),
    "lobe weight": (_lobes, (3, 4)),
    "mean mirror": (_mean_mirror, (4,)),
    "mirror light": (_mirror_light, (4, 3)),
    "decode": (lambda out: core.srgb_decode(_floats(4), out, 1), (4,)),
    "cube lookup": (_light, (_PIXELS, 3)),
    "cube pad": (_padded, (5, 4)),
    "feature light": (_features, (_PIXELS, 3)),
}  # fmt: skip


def _other_order(shape: tuple[int, ...]) -> np.ndarray:
    return np.full((*shape[:-1], 2 * shape[-1]), 7, np.float32)[..., ::2]


def _read_only(shape: tuple[int, ...]) -> np.ndarray:
    array = np.full(shape, 7, np.float32)
    array.flags.writeable = False
    return array


SPOILED = {
    "float64": lambda shape: np.full(shape, 7, np.float64),
    "other order": _other_order,
    "read-only": _read_only,
    "a list": lambda shape: np.full(shape, 7, np.float32).tolist(),
}


@pytest.mark.parametrize("spoil", SPOILED.values(), ids=SPOILED.keys())
@pytest.mark.parametrize(("call", "shape"), OUTPUTS.values(), ids=OUTPUTS.keys())
def test_an_array_that_would_be_copied_is_refused(call, shape, spoil):
    with pytest.raises((TypeError, RuntimeError), match=r"incompatible function arguments|bad.?cast"):
        call(spoil(shape))


@pytest.mark.parametrize(("call", "shape"), OUTPUTS.values(), ids=OUTPUTS.keys())
def test_the_callers_own_array_is_filled(call, shape):
    array = np.full(shape, 7, np.float32)
    call(array)
    assert (array != 7).any()
