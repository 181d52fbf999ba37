"""Every open question of the paper is a config key (method.md 10)."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from rtgs.config import compose
from rtgs.workflow.fingerprint import flatten

# Row of method.md 10: the key that decides it, the decision of `method=rtgs preset=paper`, and the alternative kept.
REGISTER: dict[int, list[tuple[str, object, object]]] = {
    1: [("method.optics.weight", "microfacet", "literal")],
    2: [("method.optics.remap", "pbrt", "none")],
    3: [("method.optics.roughness_floor", 1e-3, 1e-4)],
    4: [("method.optics.masking", "correlated", "separable")],
    5: [("method.optics.max_gain", 1.0, 16.0)],
    6: [
        ("method.materials.f0_channels", 1, 3),
        ("method.materials.f0", 0.9, 0.04),
        ("method.materials.roughness", 0.002, 0.005),
        ("method.optimizer.f0_logits", 0.005, 0.01),
        ("method.optimizer.roughness_logits", 0.005, 0.01),
    ],
    7: [("method.render.depth_ratio", 0.0, 1.0)],
    8: [("method.materials.normalized", True, False)],
    9: [("method.loss.specular_start", 1 / 3, 0.05)],
    10: [("method.loss.specular_target", 0.9, 1.0)],
    11: [
        ("method.loss.transmission_depth_form", "accum", "mean"),
        ("method.loss.transmission_depth_form", "accum", "per_hit"),
    ],
    12: [("method.transmittance.compositing", "over", "sum")],
    13: [("method.transmittance.second_bounce_gradient", True, False)],
    14: [("method.transmittance.second_offset", 2.0, 0.0)],
    15: [("mesh.of", "object", "scene")],
    16: [("method.transmittance.box", "object", "scene")],
    17: [("method.transmittance.first_bounce_end", "open", "clip")],
    18: [("method.transmittance.freeze_base", True, False)],
    19: [("method.loss.mono_normal_form", "cosine", "envgs")],
    20: [("method.loss.perceptual_form", "lpips", "vgg_l1")],
    21: [("method.transmittance.test_masks", "silhouette", "given")],
    22: [("scene.resize_ratio", None, 0.125), ("scene.split_every", 8, 10)],
    23: [("method.reflection.sh_direction", "unit", "raw")],
    24: [("method.reflection.direction_gradient", "full", "last_sh")],
    25: [("method.reflection.specular_reset", True, False)],
    26: [
        ("method.transmittance.first_bounce", "transmittance", "base"),
        ("method.transmittance.first_bounce", "transmittance", "none"),
    ],
    27: [("method.transmittance.second_bounce", "mesh", "first_bounce")],
    28: [("method.materials.specular", 1e-3, 0.1), ("schedule.sh_from", 0, 10_000)],
}
ROWS = 28
ENTRIES = [(row, *entry) for row, entries in REGISTER.items() for entry in entries]


def test_no_row_is_left_out():
    assert set(REGISTER) == set(range(1, ROWS + 1))
    for row, entries in REGISTER.items():
        assert all(decision != alternative for _, decision, alternative in entries), row


@pytest.fixture(scope="module")
def decided() -> dict[str, object]:
    config, _ = compose(["scene=demo", "method=rtgs", "preset=paper"])
    return flatten(asdict(config))


@pytest.mark.parametrize(("row", "key", "decision", "alternative"), ENTRIES)
def test_a_row_is_a_key_with_the_decision_and_its_alternative(decided, row, key, decision, alternative):
    assert decided[key] == decision, f"row {row}"
    config, _ = compose(["scene=demo", "method=rtgs", "preset=paper", f"{key}={alternative}"])
    assert flatten(asdict(config))[key] == alternative, f"row {row}"
