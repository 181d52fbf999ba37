"""rtgs: Gaussian models of scenes with glass and mirrors, on the CPU."""

from rtgs.core.version import VERSION as __version__

__all__ = ["__version__"]
