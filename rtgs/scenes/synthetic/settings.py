"""How a described scene becomes a capture."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.refuse import refuse_below, refuse_unknown_words, refuse_unless

_LARGEST_SIDE = 8192


@dataclass(frozen=True)
class FeatureSettings:
    """How many points, how exact."""

    points: int = 4000
    """At most this many."""
    noise: float = 0.004
    """Standard deviation of a coordinate, metres: the error of triangulation."""
    min_track: int = 3
    """Views that must see a point."""


@dataclass(frozen=True)
class CaptureSettings:
    """Size, samples and side files of a synthetic capture. The shipped captures have the default size and hold the
    truth of the test views only; their samples are in their ``synthetic.json``.

    Raises:
        RtgsError: a value outside its range.
    """

    width: int = 256
    height: int = 192
    lightmap: bool = False
    """For previews: light on matte surfaces is path-traced once for the scene, not for every view, in a twentieth of
    the time and with a bias, see :mod:`rtgs.scenes.synthetic.lightmap`. Not in Mitsuba's scalar variant."""
    samples: int = 32
    """Paths a pixel of training views."""
    test_samples: int = 256
    """Paths a pixel of test views, rendered as two halves that measure their noise."""
    test_every: int = 8
    """Views whose index is divisible by it are test views, as the importer splits them (method.md 8.1)."""
    truth: Literal["all", "test", "none"] = "all"
    """Which views get a truth/ folder."""
    jpeg_quality: int = 95
    """Of training images, without chroma subsampling; test images are PNG."""
    normal_tilt: float = 6.0
    """Degrees, smooth error of the monocular normals."""
    normal_noise: float = 0.0
    """Degrees, white error of the monocular normals."""
    normal_scale: float = 0.5
    """Size of the monocular normal maps, times that of the images."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("width", 8), ("height", 8), ("samples", 1), ("test_samples", 2), ("test_every", 1)):
            value = getattr(self, name)
            largest = _LARGEST_SIDE if name in ("width", "height") else 1 << 20
            refuse_unless(least <= value <= largest, f"synthesize: {name}", value, f"in {least}..{largest}")
        refuse_unknown_words(self, "synthesize")
        quality, scale = self.jpeg_quality, self.normal_scale
        refuse_unless(1 <= quality <= 100, "synthesize: jpeg_quality", quality, "in 1..100")
        refuse_unless(0 < scale <= 1, "synthesize: normal_scale", scale, "in (0, 1]")
        for name in ("normal_tilt", "normal_noise", "seed"):
            refuse_below(f"synthesize: {name}", getattr(self, name), 0)
        for name, least in (("points", 1), ("min_track", 1), ("noise", 0)):
            refuse_below(f"synthesize: features.{name}", getattr(self.features, name), least)

    def is_test(self, index: int) -> bool:
        """Whether the view of this index in name order is a test view."""
        return index % self.test_every == 0

    def view_samples(self, index: int) -> int:
        """Paths a pixel of a view."""
        return self.test_samples if self.is_test(index) else self.samples

    def has_truth(self, index: int) -> bool:
        """Whether the view gets a truth folder."""
        return self.truth == "all" or (self.truth == "test" and self.is_test(index))
