"""Finished models as files for other programs."""
