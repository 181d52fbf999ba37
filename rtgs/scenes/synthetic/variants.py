"""Which Mitsuba renders: the vectorised LLVM variant where a fit LLVM is found, else the scalar one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from rtgs.core.errors import RtgsError

LLVM_VARIANT, SCALAR_VARIANT = "llvm_ad_rgb", "scalar_rgb"

# Looked for at run time, newest first. Dr.Jit 1.5 writes llvm.minimum, which LLVM 15 and 16 cannot select on x86: the
# process aborts, and no exception can be caught. LLVM 14 crashes on AVX-512 machines.
LLVM_NAMES = (
    "libLLVM.so.20.1",
    "libLLVM.so.19.1",
    "libLLVM-18.so.1",
    "libLLVM-17.so.1",
)
LLVM_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/opt/homebrew/opt/llvm/lib",
)


def find_llvm() -> Path | None:
    """The shared library that Mitsuba's fast variant needs: ``DRJIT_LIBLLVM_PATH`` or a system LLVM 17 to 20."""
    if given := os.environ.get("DRJIT_LIBLLVM_PATH"):
        return Path(given)
    candidates = (Path(folder) / name for name in LLVM_NAMES for folder in LLVM_FOLDERS)
    return next((path for path in candidates if path.exists()), None)


def choose_variant() -> tuple[str, str]:
    """The variant :func:`load_mitsuba` takes by itself, and why, in words."""
    llvm = find_llvm()
    if llvm is None:
        return SCALAR_VARIANT, "no LLVM 17 to 20 was found (Debian: apt install libllvm19); several times slower"
    return LLVM_VARIANT, f"vectorised by {llvm.name}"


def load_mitsuba(variant: str | None = None) -> Any:
    """Import Mitsuba and make ``variant`` (None: :func:`choose_variant`) the current one.

    Raises:
        RtgsError: Mitsuba is not installed, or the LLVM variant is wanted and there is no LLVM, or one it refuses.
    """
    llvm = find_llvm()
    if llvm is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(llvm))
    chosen = variant or choose_variant()[0]
    if chosen not in (LLVM_VARIANT, SCALAR_VARIANT):
        raise RtgsError(f"Mitsuba variant {chosen!r} is not used here: choose {LLVM_VARIANT} or {SCALAR_VARIANT}")
    if chosen == LLVM_VARIANT and (llvm is None or not llvm.exists()):
        found = f"DRJIT_LIBLLVM_PATH={llvm} does not exist" if llvm else "no LLVM 17 to 20 was found"
        raise RtgsError(f"{found}: install one (Debian: apt install libllvm19), or take the variant {SCALAR_VARIANT}")
    try:
        import mitsuba
    except ImportError as error:
        raise RtgsError("path tracing needs Mitsuba 3: pip install -e '.[synthetic]' in the clone of rtgs") from error
    try:
        mitsuba.set_variant(chosen)
    except ImportError as error:
        raise RtgsError(
            f"Mitsuba's {chosen} does not start with {llvm} ({error}): set DRJIT_LIBLLVM_PATH to another LLVM, or take "
            f"the variant {SCALAR_VARIANT}"
        ) from error
    return mitsuba
