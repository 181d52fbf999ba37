"""Settings that recipes of old did not have: at which value they stay out of a recipe, and what their absence means.

``normal_hold: float = field(default=20.0, metadata={"recipe": "unless", "value": 0.0})``: at 0, which is what was done
before there was such a setting, the recipe is the old one, and a recipe without the key means 0. With ``{"recipe":
"unless default"}`` that value is the field's default.
"""

from __future__ import annotations

from dataclasses import MISSING, Field
from typing import Any

UNLESS = "unless"
UNLESS_DEFAULT = "unless default"


def left_out_at(field: Field[Any]) -> Any:
    """The value at which a dataclass field stays out of a recipe; ``dataclasses.MISSING`` if there is none."""
    kept = field.metadata.get("recipe")
    if kept == UNLESS:
        return field.metadata["value"]
    return field.default if kept == UNLESS_DEFAULT else MISSING
