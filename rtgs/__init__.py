"""rtgs: Gaussian models of scenes with glass and mirrors, on the CPU."""

__version__ = "0.1.0"
