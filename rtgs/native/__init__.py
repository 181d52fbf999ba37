"""The C++ core: kernels for AVX-512, AVX2 and a portable path, chosen at run time or by ``RTGS_ISA``."""

try:
    from rtgs.native import _core as core  # pyright: ignore[reportMissingModuleSource]
except ImportError as error:
    raise ImportError(
        f"the native core of rtgs is not built or does not load ({error}). Run `make setup` in the repository "
        "(needs a C++17 compiler), or `pip install .` again."
    ) from error

__all__ = ["core"]
REACHES = ("**/*.cpp", "**/*.h", "**/*.cmake", "../../CMakeLists.txt")
