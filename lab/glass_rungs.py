"""The rungs of ``lab.glass_ladder``: what each run knows, and the words that it is given for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rtgs.config.schema import RunConfig

SMALL = (
    *("scene.long_side=128", "schedule.total=1000", "schedule.means_lr_steps=1000", "schedule.sh_every=250"),
    *("schedule.densify_from=100", "schedule.densify_until=750", "schedule.densify_every=50"),
    *("method.density.max_surfels=10000", "method.reflection.cells=10", "method.reflection.sh_every=150"),
    *("method.reflection.densify_every=50", "method.reflection.density.max_surfels=6000"),
    *("method.transmittance.sh_every=150", "method.transmittance.densify_from=50"),
    *("method.transmittance.densify_every=50", "method.transmittance.density.max_surfels=6000"),
    *("method.transmittance.interface.count=2000", "method.loss.perceptual=0"),
)
"""Half of quick's steps on a quarter of its pixels."""
LEARNED = (
    *("method.loss.clipped=false", "method.optics.blend=srgb", "method.transmittance.normal=base"),
    *("method.transmittance.wall.light=learned", "mesh.object.surface.fit=carved"),
)
"""The glass that the rungs are of: learned weights on the hull as it is carved, as in docs/lab/transmittance.md."""
_T = "method.transmittance"
_I = f"{_T}.interface"


@dataclass(frozen=True)
class Setting:
    """One scene's files: who is trained on what, and the true surface."""

    scene: str
    split: Path  # for scene.split_file
    truth: Path  # PLY of the true container
    held_out: tuple[str, ...]


@dataclass(frozen=True)
class Rung:
    """One run: what it knows, and the words that `rtgs run` is given for it."""

    what: str
    words: Callable[[Setting, RunConfig], list[str]]
    method: str = "rtgs"


def _given(setting: Setting) -> list[str]:
    return ["mesh.source=given", f"mesh.object.given={setting.truth}"]


def _hull(*words: str) -> Callable[[Setting, RunConfig], list[str]]:
    return lambda *_: ["ablation=mesh_hull", *words]


def _paper(*words: str) -> Callable[[Setting, RunConfig], list[str]]:
    # What a file of the ablation says is overruled by SMALL: a word of its own is not.
    return lambda *_: ["ablation=paper_glass", f"{_I}.count=0", *words]


_UNBOUNDED = (f"{_T}.rim=0", f"{_T}.max_weight=0")
_ALL_GLASS = (f"{_I}.masked_share=0", f"{_T}.keep_seen=0")
_FREE = f"{_I}.normal_hold=0"
LADDER: dict[str, Rung] = {
    "truth": Rung("true mesh, true normals held fixed", lambda s, _: [*_given(s), f"{_T}.normal=mesh"]),
    "truth_mesh": Rung("true mesh, normals learned", lambda s, _: _given(s)),
    "hull": Rung("hull of the masks (default)", _hull()),
    "hull_fixed": Rung("hull, its normals held fixed", _hull(f"{_T}.normal=mesh")),
    "tsdf": Rung("TSDF of the base set", lambda *_: ["ablation=mesh_tsdf"]),
    "two_stages": Rung("no third stage", lambda *_: ["ablation=two_stages"]),
    "printed_truth_mesh": Rung(
        "the paper as printed, the true mesh", lambda s, _: [f"{_I}.count=0", *_given(s)], "rtgs_printed"
    ),
    "printed": Rung("the paper as printed", lambda *_: [f"{_I}.count=0"], "rtgs_printed"),
    "paper_truth_mesh": Rung("the paper's glass, the true mesh", lambda s, c: [*_paper()(s, c), *_given(s)]),
    "paper": Rung("the paper's glass", _paper()),
    "paper_propagation": Rung("the paper's glass, normal propagation", lambda _, c: _paper()(_, c) + _propagation(c)),
    "paper_early_specular": Rung(
        "the paper's glass, L_spec from the second stage on",
        lambda _, c: _paper(f"method.loss.specular_start={c.method.reflection.start}")(_, c),
    ),
    "paper_mono_in_mask": Rung(
        "the paper's glass, L_mono of weight 0.2 in the mask",
        lambda _, c: _paper(f"method.loss.mono_normal_masked={_masked_gain(c)}")(_, c),
    ),
    "paper_early_third": Rung(
        "the paper's glass, third stage right after the second begins",
        lambda _, c: _paper(f"{_T}.start={c.method.reflection.start + 0.05:g}")(_, c),
    ),
    "early_third_stage": Rung(
        "hull, third stage right after the second begins",
        lambda _, c: _hull(f"{_T}.start={c.method.reflection.start + 0.05:g}")(_, c),
    ),
    "early_specular": Rung(
        "hull, L_spec from the second stage on",
        lambda _, c: _hull(f"method.loss.specular_start={c.method.reflection.start}")(_, c),
    ),
    "normals_free": Rung("hull, its normals not held", _hull(_FREE)),
    "normal_hold_1": Rung("hull, normal hold 1 (default 20)", _hull(f"{_I}.normal_hold=1")),
    "normal_hold_5": Rung("hull, normal hold 5", _hull(f"{_I}.normal_hold=5")),
    "normal_loss_02": Rung("hull, loss 0.2 on the rasterised normal", _hull(_FREE, f"{_I}.normal_loss=0.2")),
    "normal_loss_5": Rung("hull, loss 5 on the rasterised normal", _hull(_FREE, f"{_I}.normal_loss=5")),
}
CHOICES: dict[str, Rung] = {
    "before_all_glass": Rung("hull, no rim, w_r not bounded, all of it glass", _hull(*_UNBOUNDED, *_ALL_GLASS)),
    "before": Rung("hull, no rim, w_r not bounded", _hull(*_UNBOUNDED)),
    "before_faint": Rung("hull, no rim, w_r not bounded but from 0.25", _hull(*_UNBOUNDED, f"{_I}.f0=0.05")),
    "no_rim": Rung("hull, no rim", _hull(f"{_T}.rim=0")),
    "no_bound": Rung("hull, w_r not bounded", _hull(f"{_T}.max_weight=0")),
    "all_glass": Rung("hull, all of it glass", _hull(*_ALL_GLASS)),
    "faint_start": Rung("hull, w_r from 0.25", _hull(f"{_I}.f0=0.05")),
    "growing_base": Rung("hull, density control of the base set goes on", _hull(f"{_T}.freeze_base=false")),
}
RUNGS = LADDER | CHOICES
GROUPS: dict[str, tuple[str, ...]] = {
    "ladder": tuple(LADDER),
    "choices": (*CHOICES, "hull", "two_stages"),
}
"""Names for several rungs: the ladder, and the choices of the default rung that docs/transmittance.md names."""


def _propagation(config: RunConfig) -> list[str]:
    """EnvGS's normal propagation in the second stage: a twenty-fifth of the run apart, as rests of it in proportion.

    No scene is on probation: normals wait for its end, and in short runs it ends where the third stage begins.
    """
    words = {"every": max(1, config.schedule.total // 25), "hold_every": max(1, config.schedule.total // 125)}
    words |= {"until": config.method.transmittance.start, "densify_every": config.schedule.densify_every}
    chosen = [f"method.reflection.propagation.{key}={value}" for key, value in words.items()]
    return [*chosen, "method.reflection.matte.probation=0"]


def _masked_gain(config: RunConfig) -> float:
    """What brings the weight of L_mono to 0.2 (decision 47: 0.05 does little, 0.2 forms the glass)."""
    return 0.2 / (config.method.loss.mono_normal * config.method.loss.mono_normal_gain)
