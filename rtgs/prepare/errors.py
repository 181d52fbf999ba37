"""The error of the preparation."""

from __future__ import annotations

from rtgs.core.errors import RtgsError


class PrepareError(RtgsError):
    """Photos, a video or a model from which nothing can be prepared: what is wrong, the value, where, what to do."""
