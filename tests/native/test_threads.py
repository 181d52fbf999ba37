"""How many threads the core takes: what is refused, and what a forked child gets."""

import hashlib
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from rtgs.native import core
from rtgs.native.threads import borrow, in_threads, serial_torch, settled_threads, threaded_torch, threads
from tests.render.native_scene import SCENE_OPTIONS, native_scene
from tests.render.native_trace_scene import everything, native_trace_scene


def _floats(*shape: int) -> np.ndarray:
    return np.full(shape, 0.5, np.float32)


def _raster(threads: int) -> None:
    scene = native_scene(count=3, width=16, height=16, channels=3)
    rotation, translation = scene.camera.rotation.numpy(), scene.camera.translation.numpy()
    camera = core.RasterCamera(rotation, translation, 10, 10, 8, 8, 16, 16, 0.2, 100)
    core.Rasterization(camera, False, False).project(*(tensor.numpy() for tensor in scene.tensors), threads)


def _ellipsoids(threads: int) -> None:
    scene = native_scene(count=3, width=16, height=16, channels=3)
    rotation, translation = scene.camera.rotation.numpy(), scene.camera.translation.numpy()
    camera = core.RasterCamera(rotation, translation, 10, 10, 8, 8, 16, 16, 0.2, 100)
    arrays = [tensor.numpy() for tensor in scene.tensors]
    arrays[3] = _floats(3, 3)
    core.EllipsoidRasterization(camera, 0.3, 3.0, False, False).project(*arrays, threads)


def _tree(method: str, threads: int) -> None:
    arrays = [tensor.numpy() for tensor in native_trace_scene(count=20, rays=1).all()[:5]]
    tree = core.SurfelTree()
    tree.build(*arrays, 1 / 255, threads if method == "build" else 1)
    tree.refit(*arrays, 1 / 255, threads)


def _activate(threads: int) -> None:
    raw = (_floats(2, 3), _floats(2, 2), _floats(2, 4), _floats(2), _floats(2, 3), _floats(2, 15, 3))
    out = (_floats(2, 3), _floats(2, 3), _floats(2, 2), _floats(2), _floats(2, 3))
    core.activate_gaussians(raw, (0.0, 0.0, 0.0), 0, out, None, threads)


def _normal(threads: int) -> None:
    maps = _floats(3, 8, 8), _floats(8, 8), _floats(8, 8)
    core.normal_consistency_loss(*maps, True, np.eye(3, dtype=np.float32), _floats(4), 0.1, 1.0, *[None] * 3, threads)


def _mirror(threads: int) -> None:
    maps = _floats(4, 3), _floats(4), _floats(4, 3)
    core.mirror_rays(*maps, (0.0, 0.0, 0.0), 1e-6, False, None, _floats(4, 3), _floats(4, 3), _floats(4), threads)


def _filter(threads: int) -> None:
    rows, numbers = np.zeros(1, np.int32), (_floats(1), np.zeros(8, np.int32), _floats(1), _floats(1))
    maps = _floats(1, 3), _floats(1, 32), _floats(1, 3)
    core.cube_filter(rows, np.array([0, 1], np.int64), rows, *numbers, *maps, threads)


def _features(threads: int) -> None:
    network = [(16, 80), (16, 16), (8, 16), (80, 16), (16, 16), (16, 16), (16,), (16,), (16,)]
    sides, arrays = np.array([4, 2], np.int32), tuple(_floats(*shape) for shape in network)
    rays, work = (_floats(4, 3), _floats(4), _floats(4, 4)), _floats(core.feature_scratch(16))
    core.feature_light(
        _floats(40, 16), sides, arrays, *rays, work, _floats(4, 16), _floats(4, 2), _floats(4, 3), threads
    )


def _far_wall(threads: int) -> None:
    given, rows = (None, _floats(2, 3), _floats(0, 3), _floats(0)), (np.arange(2), np.zeros(0, np.int64))
    core.far_wall(_floats(3, 4), given, rows, (1.5, None), _floats(3, 4), threads)


def _far_wall_backward(threads: int) -> None:
    given, rows = (None, _floats(2, 3), _floats(0, 3), _floats(0)), (np.arange(2), np.zeros(0, np.int64))
    core.far_wall_backward(_floats(3, 4), given, rows, (1.5, None), _floats(3, 4), given, _floats(4), threads)


def _leg_backward(threads: int) -> None:
    leg = _floats(4, 3), _floats(4), _floats(4, 3), None, _floats(4)
    core.wall_leg_backward(leg, _floats(4), (1.5, None), _floats(4, 3), leg, _floats(4), threads)


def _blend(threads: int) -> None:
    light = [_floats(2)], [_floats(3, 2)], None, True, False
    core.blend_lights(np.arange(2), _floats(3, 4), _floats(2), *light, _floats(3, 4), threads)


def _blend_backward(threads: int) -> None:
    light, to = ([_floats(2)], [_floats(3, 2)], None, True, False), (None, None, [None], [None])
    core.blend_lights_backward(np.arange(2), _floats(3, 4), _floats(2), *light, _floats(3, 4), *to, threads)


CALLS = {
    "rasterise surfels": _raster,
    "rasterise ellipsoids": _ellipsoids,
    "build a tree": lambda threads: _tree("build", threads),
    "refit a tree": lambda threads: _tree("refit", threads),
    "trace": lambda threads: core.Tracing(1e-4, 1 / 255, 0, False, False, "given", threads),
    "activate": _activate,
    "adam": lambda threads: core.adam_step(
        [(*(_floats(4, 2) for _ in range(4)), 2, 0.1)], 0.9, 0.99, 1e-8, 1.0, threads
    ),
    "count": lambda threads: core.count_nonfinite(_floats(4), threads),
    "photometric": lambda threads: core.photometric_loss(
        _floats(3, 8, 8), _floats(3, 8, 8), 1.0, 1.0, True, None, None, threads
    ),
    "normal consistency": _normal,
    "mono normal": lambda threads: core.mono_normal_loss(
        _floats(3, 8, 8), _floats(3, 8, 8), None, np.eye(3, dtype=np.float32), 1.0, None, threads
    ),
    "mirror rays": _mirror,
    "microfacet": lambda threads: core.microfacet_reflection(
        _floats(4), _floats(4), _floats(4), 1e-3, 1e-3, 1.0, _floats(4), threads
    ),
    "lobe weight": lambda threads: core.lobe_weight(
        *(_floats(4) for _ in range(3)), _floats(2, 2, 2), 2, 1.0, 1e-3, _floats(4), threads
    ),
    "mean mirror": lambda threads: core.mean_mirror(
        _floats(3, 4), _floats(4), _floats(3, 4), True, 1e-6, 1e-6, _floats(4, 3), _floats(4), threads
    ),
    "mirror light": lambda threads: core.mirror_light(
        *(_floats(4, 3) for _ in range(3)), (0.0, 0.0, 0.0), _floats(4, 3), _floats(4, 45), _floats(4, 3), threads
    ),
    "decode": lambda threads: core.srgb_decode(_floats(4), _floats(4), threads),
    "wall": lambda threads: core.wall_reflectance(_floats(4), 1.5, _floats(4), threads),
    "wall leg": lambda threads: core.wall_leg(
        (_floats(4, 3), _floats(4), _floats(4, 3), None, _floats(4)), _floats(4), (1.5, None), _floats(4, 3), threads
    ),
    "far wall": _far_wall,
    "wall, backward": lambda threads: core.wall_reflectance_backward(
        _floats(4), 1.5, _floats(4), _floats(4), _floats(1), threads
    ),
    "wall leg, backward": _leg_backward,
    "far wall, backward": _far_wall_backward,
    "blend": _blend,
    "blend, backward": _blend_backward,
    "take": lambda threads: core.take_planes(np.arange(2), 4, [_floats(4)], [_floats(2)], threads),
    "put": lambda threads: core.put_planes(np.arange(2), 4, [_floats(2)], [_floats(4)], threads),
    "encode": lambda threads: core.srgb_encode(_floats(4), _floats(4), threads),
    "cube lookup": lambda threads: core.cube_lookup(
        _floats(6 * 16, 4), np.array([2], np.int32), _floats(4, 3), _floats(0), _floats(4, 3), threads
    ),
    "cube filter": _filter,
    "feature light": _features,
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS.keys())
def test_every_entry_refuses_numbers_of_threads_that_are_none(call):
    for count in (0, -1, -(2**31), 1025, 100_000):
        with pytest.raises(ValueError, match=rf"threads={count} must be 1 to 1024"):
            call(count)
    call(1)
    call(3)


def test_percentiles_on_no_grid_are_refused():
    with pytest.raises(ValueError, match="step=0 must be at least 1"):
        core.depth_percentiles(_floats(8, 8), None, 0.5, 0)


def test_callers_at_once_and_more_parts_than_cores_give_the_same_bits():
    scene = native_scene(count=500, width=70, height=50, channels=3)

    def digest(count: int) -> str:
        torch.set_num_threads(count)  # of this thread of Python
        leaves = scene.leaves()
        pixels = scene.render(SCENE_OPTIONS, leaves).features
        found = [pixels.detach(), *torch.autograd.grad(pixels.square().sum(), leaves)]
        found += everything(native_trace_scene(count=300, rays=1500))
        return hashlib.sha256(b"".join(each.detach().numpy().tobytes() for each in found)).hexdigest()

    before = torch.get_num_threads()
    try:
        alone = digest(1)
        with ThreadPoolExecutor(4) as executor:
            found = set(executor.map(digest, [2, 3, 5, 16, 1024, 1, 7, 64] * 3))
        assert found == {alone}
        assert digest(1024) == alone
    finally:
        torch.set_num_threads(before)


@pytest.fixture
def three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
def test_kernels_keep_their_threads_where_torch_is_serial():
    def found() -> tuple[int, int]:
        return threads(), torch.get_num_threads()

    assert found() == (3, 3)
    with serial_torch(wanted=False):
        assert found() == (3, 3)
    with serial_torch():
        assert found() == (3, 1)
        with threaded_torch():
            assert found() == (3, 3)
        with serial_torch():
            assert found() == (3, 1)
        assert found() == (3, 1)
    assert found() == (3, 3)
    with pytest.raises(ZeroDivisionError), serial_torch():
        1 / 0  # noqa: B018
    assert found() == (3, 3)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.usefixtures("three_threads")
def test_kernels_of_a_forked_child_take_one_thread():
    with serial_torch():
        child = os.fork()
        if child == 0:
            os._exit(10 + threads())
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 11


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_child_forked_after_threads_were_used_renders_the_same_bits():
    done = subprocess.run([sys.executable, "-c", _FORKS], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, (done.returncode, done.stderr[-2000:])
    parent, child, raw = done.stdout.split()
    assert parent == child
    assert raw == "0"


@pytest.mark.skipif(sys.platform != "linux", reason="a limit on threads")
def test_where_the_system_gives_no_thread_the_work_is_done_all_the_same():
    done = subprocess.run([sys.executable, "-c", _NO_THREADS], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, (done.returncode, done.stderr[-2000:])
    alone, *refused, found = done.stdout.split()
    if not refused:
        pytest.skip("no limit on threads is enforced here")
    assert found == alone


# The limit does not bind root. torch's own threads, which it would end the process for, are not used.
_NO_THREADS = """
import hashlib, os, resource, threading
import torch
from rtgs.native.threads import serial_torch
from tests.render.native_scene import SCENE_OPTIONS, native_scene

def digest():
    scene = native_scene(count=400, width=97, height=64, channels=3)
    leaves = scene.leaves()
    pixels = scene.render(SCENE_OPTIONS, leaves).features
    with torch.autograd.set_multithreading_enabled(False):
        found = [pixels.detach(), *torch.autograd.grad(pixels.square().sum(), leaves)]
    return hashlib.sha256(b"".join(each.detach().numpy().tobytes() for each in found)).hexdigest()

torch.set_num_threads(1)
print(digest(), flush=True)
if os.geteuid() == 0:
    os.setgid(65534)
    os.setuid(65534)
resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
try:
    threading.Thread(target=print).start()
except RuntimeError:
    print("refused", flush=True)
torch.set_num_threads(3)
with serial_torch():
    print(digest(), flush=True)
"""

# A child that waits for threads which only its parent has would wait for ever: the alarm ends it.
_FORKS = """
import hashlib, os, signal, sys
import torch
from rtgs.native import core
from tests.render.native_scene import SCENE_OPTIONS, native_scene
from tests.render.native_trace_scene import everything, native_trace_scene

def digest():
    scene = native_scene(count=400, width=97, height=64, channels=3)
    leaves = scene.leaves()
    pixels = scene.render(SCENE_OPTIONS, leaves).features
    found = [pixels.detach(), *torch.autograd.grad(pixels.square().sum(), leaves)]
    found += everything(native_trace_scene(count=300, rays=1500))
    large = torch.ones(400, 400)
    found.append((large @ large).exp().sum())  # torch's own threads
    return hashlib.sha256(b"".join(each.detach().numpy().tobytes() for each in found)).hexdigest()

torch.set_num_threads(2)
print(digest(), flush=True)
child = os.fork()
if child == 0:
    signal.alarm(120)
    print(digest(), flush=True)
    print(core.count_nonfinite(torch.zeros(1 << 20).numpy(), 2), flush=True)  # whatever number is asked for
    os._exit(0)
_, status = os.waitpid(child, 0)
sys.exit(os.waitstatus_to_exitcode(status))
"""


def test_work_in_threads_keeps_its_order_and_tells_what_went_wrong():
    assert in_threads(lambda a, b: 10 * a + b, range(50), range(50)) == [11 * k for k in range(50)]
    assert in_threads(abs, []) == []
    with pytest.raises(ValueError, match="shorter"):
        in_threads(lambda a, b: a, [1, 2, 3], [1])
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda a: 1 / a, [2, 1, 0])


def test_lent_threads_are_for_kernels_alone():
    """Torch's own operations, whose bits may depend on their number, never have them."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    lent = 1
    try:
        with borrow(lambda: lent):
            assert threads() == 2  # nobody takes away what a process has
            with serial_torch():
                assert threads() == 2
                lent = 5
                assert (threads(), settled_threads(), torch.get_num_threads()) == (5, 2, 1)
                with threaded_torch():
                    assert torch.get_num_threads() == 2
                with serial_torch():
                    assert settled_threads() == 2
            assert (threads(), settled_threads(), torch.get_num_threads()) == (5, 2, 2)
        assert threads() == 2
        with serial_torch():
            assert threads() == 2
    finally:
        torch.set_num_threads(before)
