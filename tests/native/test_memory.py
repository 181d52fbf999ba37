"""Where memory runs out in the core: MemoryError, and what is done afterwards is right."""

import subprocess
import sys

import pytest
import torch

from rtgs.native import core
from tests.render.native_scene import SCENE_OPTIONS, native_scene
from tests.render.native_trace_scene import assert_same_bits, everything, native_trace_scene

_MOST = 200  # allocations of one call, far more than there are


@pytest.fixture(autouse=True)
def _fresh_memory():
    """Idle memory would be used again, and nothing asked for."""
    _forget()
    yield
    core.fail_allocation(-1)
    _forget()


def _forget() -> None:
    core.release_raster_memory()
    core.release_trace_memory()


def _rasterise() -> list[torch.Tensor]:
    scene = native_scene(count=120, width=48, height=32, channels=3)
    leaves = scene.leaves()
    buffers = scene.render(SCENE_OPTIONS, leaves)
    return [buffers.features.detach(), *torch.autograd.grad(buffers.features.square().sum(), leaves)]


def _trace() -> list[torch.Tensor]:
    return everything(native_trace_scene(count=200, rays=1500))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("work", [_rasterise, _trace])
@pytest.mark.usefixtures("isa")
def test_each_allocation_that_fails_is_a_memory_error_and_leaves_nothing_behind(work, threads: int):
    torch.set_num_threads(threads)
    expected = work()
    failures = 0
    for number in range(_MOST):
        _forget()
        core.fail_allocation(number)
        try:
            work()
        except MemoryError:
            failures += 1
        else:
            break
    assert 5 < failures < _MOST - 1
    core.fail_allocation(-1)  # and with the memory that the failures left
    for found, wanted in zip(work(), expected, strict=True):
        assert torch.equal(found, wanted)


def test_a_tree_that_could_not_be_built_is_empty_and_can_be_built_again():
    scene = native_trace_scene(count=200, rays=1)
    arrays = [tensor.numpy() for tensor in scene.all()[:5]]
    tree = core.SurfelTree()
    core.fail_allocation(0)
    with pytest.raises(MemoryError):
        tree.build(*arrays, 1 / 255, 1)
    assert (tree.surfels, tree.nodes) == (0, 1)
    tree.build(*arrays, 1 / 255, 1)
    assert tree.surfels == 200
    assert_same_bits(everything(scene), everything(scene))


def test_a_rasterisation_without_its_projection_is_refused():
    scene = native_scene(count=3, width=16, height=16, channels=3)
    rotation, translation = scene.camera.rotation.numpy(), scene.camera.translation.numpy()
    camera = core.RasterCamera(rotation, translation, 10, 10, 8, 8, 16, 16, 0.2, 100)
    native = core.Rasterization(camera, False, False)
    with pytest.raises(RuntimeError, match="comes first"):
        native.forward(None, torch.zeros(3, 16, 16).numpy(), None, torch.zeros(16, 16).numpy(), None, None, None, None)


@pytest.mark.skipif(sys.platform != "linux" or core.sanitized, reason="a limit on addresses needs Linux, and no ASan")
@pytest.mark.parametrize(("work", "count"), [("rasterise", "10000"), ("trace", "60000")])
def test_out_of_addresses_is_a_memory_error(work: str, count: str):
    done = subprocess.run([sys.executable, "-c", _LIMITED, work, count], capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.returncode, done.stderr[-2000:])
    assert done.stdout.split() == ["MemoryError", "alive"]


# The inputs are made before: what torch cannot allocate is torch's error, not the core's.
_LIMITED = """
import resource, sys
from dataclasses import replace
import torch
from rtgs.native import core
from rtgs.render.trace import trace_surfels
from tests.render.native_scene import SCENE_OPTIONS, native_scene
from tests.render.native_trace_scene import native_trace_scene
from tests.render.trace_scenes import all_outputs

torch.set_num_threads(1)
def rasterise(count):
    scene = native_scene(count, 640, 480, 3, size=3.0)
    return lambda: scene.render(SCENE_OPTIONS)
def trace(count):
    scene = native_trace_scene(600, count, size=3.0)
    scene = replace(scene, opacities=torch.full_like(scene.opacities, 0.02))  # so that every ray meets hundreds
    positional, named = scene.leaves(torch.float32).arguments()
    return lambda: trace_surfels(*positional, **named, options=all_outputs())
prepare = {"rasterise": rasterise, "trace": trace}[sys.argv[1]]
few, many = prepare(100), prepare(int(sys.argv[2]))
few()
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (24 << 20), resource.RLIM_INFINITY))
try:
    many()
except MemoryError:
    print("MemoryError")
resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
few()
print("alive")
"""
