"""Pictures of another program in the place of a method: nothing is trained (docs/external.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtgs.core.errors import RtgsError
from rtgs.methods.spec import MethodSpec

if TYPE_CHECKING:
    from rtgs.methods.model import Model
    from rtgs.methods.spec import Setup


def build(setup: Setup) -> Model:
    """There is no model.

    Raises:
        RtgsError: always.
    """
    raise RtgsError("method=external trains nothing: it scores the pictures in external.renders; choose another method")


SPEC = MethodSpec("external", (), build, elsewhere=True)
