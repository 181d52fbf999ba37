"""What is learned of each training photo beside the scene: exposure, and the pose of its camera (docs/photos.md)."""

from __future__ import annotations

from dataclasses import dataclass, field

from rtgs.core.recipe import UNLESS_DEFAULT
from rtgs.core.refuse import refuse_bad_counts, refuse_bad_numbers, refuse_unless


@dataclass(frozen=True)
class AppearanceSettings:
    """Exposure and tint of each training photo; a test view is told by the nearest (decision 65).

    Numbers of PPISP's exposure and colour (nv-tlabs/ppisp), its vignetting and response curve left out.
    """

    enabled: bool = False
    # Learned as well where half of the photos differ from the median one by more stops; None: not looked at. Short
    # presets: photos of six captures by .06 to .11, path-traced ones by at most .03 (docs/photos.md).
    learn_above: float | None = field(default=None, metadata=UNLESS_DEFAULT)
    rate: float = 2e-3  # of Adam, in stops and in shares of a channel
    rate_end: float = 2e-5  # at the end of the run
    warm_up: int = 500  # steps over which the rate rises, at most a quarter of the run
    mean_exposure: float = 1.0  # weight of what holds the mean over the photos at 0 stops (smooth L1, beta 0.1)
    mean_color: float = 1.0  # and their mean tint at none

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.appearance")
        for name in ("rate", "rate_end"):
            value = getattr(self, name)
            refuse_unless(value > 0, f"method.appearance.{name}", value, "above 0 (enabled=false learns nothing)")
        refuse_bad_counts(self, "method.appearance", warm_up=0)


@dataclass(frozen=True)
class PoseSettings:
    """Small motions of the training cameras, of methods that rasterise only (decision 66). Numbers of gsplat."""

    enabled: bool = False
    # Learned as well, by methods that can, where a pose is unsure by more pixels of the training photos: the median
    # standard error, from what the points of a COLMAP model miss them by. None: not looked at. Short presets.
    learn_above: float | None = field(default=None, metadata=UNLESS_DEFAULT)
    rate: float = 1e-5  # of Adam: radians, and shares of the scene's extent
    rate_end: float = 1e-7  # at the end of the run
    decay: float = 1e-6  # of Adam's gradient per unit of motion

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.poses")
        for name in ("rate", "rate_end"):
            value = getattr(self, name)
            refuse_unless(value > 0, f"method.poses.{name}", value, "above 0 (enabled=false learns nothing)")
