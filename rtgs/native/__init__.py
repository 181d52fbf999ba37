"""The C++ core: kernels for AVX-512, AVX2 and a portable path, chosen at run time or by ``RTGS_ISA``."""

import os
import sys

try:
    from rtgs.native import _core as core  # pyright: ignore[reportMissingModuleSource]
except ImportError as error:
    raise ImportError(
        f"the native core of rtgs is not built or does not load ({error}). Run `make setup` in the repository "
        "(needs a C++17 compiler), or `pip install .` again."
    ) from error


def _in_forked_child() -> None:
    """torch would wait for ever for its threads, which stay with the parent."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_forked_child)

__all__ = ["core"]
REACHES = ("**/*.cpp", "**/*.h", "**/*.cmake", "../../CMakeLists.txt")
