"""Recipe fingerprints: SHA-256 of canonical JSON (docs/pipeline.md).

A fingerprint names a *recipe* (what would be computed), so the keys of a whole graph are known before anything runs.
"""

from __future__ import annotations

import hashlib
import json

from rtgs.core.recipe import canonical_json


def fingerprint(value: object) -> str:
    """64 hexadecimal digits: SHA-256 of the canonical JSON of a recipe."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def recipe_params(params: object) -> dict[str, object]:
    """The parameters as they enter the fingerprint and are written to a manifest: plain JSON values.

    Raises:
        TypeError, ValueError: as :func:`rtgs.core.recipe.canonical_json`.
    """
    plain = json.loads(canonical_json(params))
    return plain if isinstance(plain, dict) else {"value": plain}
