"""``make sanitize``: builds the core with the sanitizers of addresses and undefined behaviour, runs its tests on it.

Once for each instruction set. The first report of a sanitizer ends the tests.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SETS = ("portable", "avx512")
PLUGIN, VARIABLE = "tests.native.sanitized", "RTGS_SANITIZED_CORE"
TESTS = (
    "tests/native",
    "tests/render",
    "tests/gaussians/test_activate.py",
    "tests/gaussians/test_adam.py",
    "tests/train/test_losses.py",
    "tests/train/test_sensor.py",
    "tests/methods/test_mirror_native.py",
    "tests/methods/test_blend_native.py",
    "tests/methods/test_traced_pixels.py",
    "tests/methods/test_inner_native.py",
    "tests/methods/test_far_wall_native.py",
    "tests/methods/test_wall_weights_native.py",
    "tests/methods/test_thread_bits.py",
    "tests/optics/test_light.py",
    "tests/optics/test_walls_native.py",
    "tests/mesh/test_outlines_native.py",
    "tests/light/test_cube_lookup.py",
    "tests/light/test_feature_network.py",
)
# A read past the end of an array, which the sanitizer must report: else it is not at work.
_CANARY = f"""
import numpy as np
import {PLUGIN}
from rtgs.native import core
image, target = np.ones((3, 64, 64), np.float32), np.ones((3, 32, 32), np.float32)
core.photometric_loss(image, target, 1.0, 1.0, True, None, None, 1)
"""
_EXPECTED = "AddressSanitizer: heap-buffer-overflow"


def build(folder: Path, jobs: int) -> Path:
    """Configure and build in ``folder``; the module."""
    configure = ["cmake", "-S", str(ROOT), "-B", str(folder), "-G", "Ninja", "-DRTGS_SANITIZE=ON"]
    configure += ["-DCMAKE_BUILD_TYPE=RelWithDebInfo", f"-DPython_EXECUTABLE={sys.executable}"]
    tools = os.environ | {"PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])}
    subprocess.run(configure, env=tools, check=True)
    subprocess.run(["cmake", "--build", str(folder), "-j", str(jobs)], env=tools, check=True)
    (module,) = folder.glob("_core*.so")
    return module


def environment(module: Path, isa: str) -> Mapping[str, str]:
    """Of a process that loads the module: the sanitizer's library comes first, then C++'s, whose throw it wraps."""
    compiler = os.environ.get("CXX", "c++")
    names = ("libasan.so", "libstdc++.so")
    ask = [[compiler, f"-print-file-name={name}"] for name in names]
    found = [subprocess.run(each, capture_output=True, text=True, check=True).stdout.strip() for each in ask]
    return os.environ | {
        "LD_PRELOAD": " ".join(str(Path(path).resolve()) for path in found),
        "ASAN_OPTIONS": "detect_leaks=0",  # the interpreter's own
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "RTGS_ISA": isa,
        VARIABLE: str(module),
    }


def check_alarm(module: Path, isa: str) -> None:
    """Stop where a real error is not reported."""
    command = [sys.executable, "-c", _CANARY]
    done = subprocess.run(command, env=environment(module, isa), cwd=ROOT, capture_output=True, text=True)
    if done.returncode == 0 or _EXPECTED not in done.stderr:
        sys.exit(f"{isa}: the sanitizer did not report a read past an array:\n{done.stderr[-4000:]}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Build, check, test; returns the exit code."""
    parser = argparse.ArgumentParser("make sanitize", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--build", type=Path, default=ROOT / "build" / "sanitize", help="folder (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="of the compiler")
    parser.add_argument("--isa", nargs="+", default=SETS, choices=("portable", "avx2", "avx512"))
    parser.add_argument("tests", nargs="*", default=TESTS, help="files and options for pytest")
    options = parser.parse_args(arguments)
    module = build(options.build.absolute(), options.jobs)
    failed = []
    for isa in options.isa:
        check_alarm(module, isa)
        print(f"{isa}: the alarm works; tests:", flush=True)
        command = [sys.executable, "-m", "pytest", "-x", "-p", PLUGIN, *options.tests]
        if subprocess.run(command, env=environment(module, isa), cwd=ROOT).returncode:
            failed.append(isa)
    print(f"with reports or failures: {', '.join(failed)}" if failed else f"clean: {', '.join(options.isa)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
