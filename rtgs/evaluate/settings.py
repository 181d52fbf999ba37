"""What an evaluation computes, and of whose pictures. Without torch: the config schema holds it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.recipe import UNLESS_DEFAULT
from rtgs.core.refuse import refuse_bad_counts, refuse_unknown_words, refuse_unless

Colors = Literal["auto", "srgb", "linear"]
Larger = Literal["refuse", "shrink"]
_LONGEST_NAME = 60  # characters: it heads a row of tables


@dataclass(frozen=True)
class EvaluationSettings:
    """Which groups of columns are computed, and of which pictures."""

    lpips: bool = True  # both input conventions, when the weights are on this machine
    masked: bool = True  # inside the mask, for views that have one
    eight_bit: bool = True  # after rounding to 1/255, the protocol of codes that measure saved PNGs
    # Pictures, not maps and layers, are rendered so many times finer and averaged, as the photos were
    # (rtgs/evaluate/supersample.py).
    supersample: int = field(default=1, metadata=UNLESS_DEFAULT)
    # Test poses are fitted to their photos for one figure more, psnr_refined_poses: where method.poses learns those of
    # the training views, or wherever the method can ("always"), or never.
    refined_poses: Literal["learned", "always", "never"] = field(default="learned", metadata=UNLESS_DEFAULT)
    refine_steps: int = field(default=50, metadata=UNLESS_DEFAULT)

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "evaluation")
        refuse_bad_counts(self, "evaluation", refine_steps=1)
        times = self.supersample
        refuse_unless(1 <= times <= 8, "evaluation.supersample", times, "a whole number from 1 to 8")


@dataclass(frozen=True)
class ExternalSettings:
    """Pictures of another program, which ``method=external`` scores as those of a method (docs/external.md)."""

    renders: str = ""
    """Folder with one picture per test view, found by the view's name."""
    name: str = ""
    """The row's label in tables: the other program. Empty: ``external``."""
    layers: str = ""
    """Folder of folders ``reflection``, ``transmission``, ``depth``, ``normal``, named alike inside. Empty: none."""
    colors: Colors = "auto"
    """``srgb``: values as photos hold them. ``linear``: light, encoded before it is scored. ``auto``: sRGB, and what
    says or looks otherwise is refused."""
    larger: Larger = "refuse"
    """Of pictures larger than the views: ``shrink`` them as photos are shrunk, or ``refuse`` them."""

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "external")
        legal = len(self.name) <= _LONGEST_NAME and self.name.isprintable() and "," not in self.name
        allowed = f"printable, without a comma, of at most {_LONGEST_NAME} characters: it heads a row of tables"
        refuse_unless(legal, "external.name", repr(self.name), allowed)
