"""What was freed goes back to the system, and threads share one heap."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from rtgs.core.memory import hand_back


def resident_mb() -> float:
    """Of this process, now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


SHARED = "from rtgs.core.memory import share_one_heap; share_one_heap()"
OF_A_RUN = """
from pipelines.cli.app import _process
from rtgs.config.schema import RunConfig
process = _process(RunConfig())
process.__enter__()
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc hands back what lies below a used block")
def test_what_was_freed_is_handed_back():
    kept = [bytearray(b"x" * 60_000) for _ in range(4_000)]  # 240 MB in blocks too small for mappings of their own
    last, high = kept.pop(), resident_mb()  # the heap cannot shrink from its end
    kept.clear()
    hand_back()
    assert resident_mb() < high - 180
    assert len(last) == 60_000


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has heaps for threads")
@pytest.mark.parametrize(("first", "heaps"), [(SHARED, "1"), (OF_A_RUN, "1"), ("", "more")])
def test_threads_share_one_heap(first: str, heaps: str, tmp_path: Path):
    """In a process of its own: it holds for the whole of it. A run has it before any step, and not only in trainings:
    the object's mesh is made in threads."""
    code = f"""
import ctypes, threading
{first}
meet = threading.Barrier(3)
library = ctypes.CDLL(None)
library.malloc.restype = ctypes.c_void_p
def allocate():
    meet.wait()
    assert library.malloc(5000)
    meet.wait()
threads = [threading.Thread(target=allocate) for _ in range(3)]
[each.start() for each in threads]
[each.join() for each in threads]
library.fopen.restype = ctypes.c_void_p
file = library.fopen({str(tmp_path / "info").encode()!r}, b"w")
assert library.malloc_info(0, ctypes.c_void_p(file)) == 0
library.fclose(ctypes.c_void_p(file))
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
    found = (tmp_path / "info").read_text().count("<heap nr=")
    assert found == 1 if heaps == "1" else found > 1
