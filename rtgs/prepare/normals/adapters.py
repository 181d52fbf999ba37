"""What the numbers of monocular normal networks mean, declared family by family."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rtgs.core.refuse import refuse_unknown_words, refuse_unless

NormalNetwork = Literal["stablenormal", "dsine", "omnidata", "metric3d"]
_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class NormalAdapter:
    """How a normal network wants its picture and what its numbers mean.

    Raises:
        RtgsError: axes that are not three different ones, an unknown way to fit.
    """

    input: str = ""
    """Name of the picture's input; empty: the first."""
    intrinsics: str = ""
    """Name of an input of shape (1, 3, 3) for the calibration matrix, in pixels of the input; empty: none."""
    output: str = ""
    """Name of the output; empty: the first. Channels beyond the third (confidence) are left out."""
    axes: tuple[str, ...] = ("+x", "+y", "+z")
    """What the output's three channels are, in x right, y down, z forward of the camera."""
    unit_range: bool = False
    """The output holds (n + 1) / 2 in 0..1 instead of n."""
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    """The network sees (picture - mean) / std, the picture in 0..1: a std of 1/255 gives it 0..255."""
    channels_last: bool = False
    """(1, H, W, 3) instead of (1, 3, H, W), input and output."""
    fit: Literal["multiple", "stretch", "pad"] = "multiple"
    """``multiple``: shrink to ``size`` on the long side and round both sides to a multiple of ``multiple``;
    ``stretch``: to size x size, aspect lost; ``pad``: shrink into (height, width) = ``box`` and pad with ``fill``."""
    size: int = 768
    multiple: int = 32
    box: tuple[int, ...] = (616, 1064)
    fill: tuple[float, ...] = IMAGENET_MEAN
    """Colour of the padding, 0..1."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "axes", tuple(self.axes))
        refuse_unknown_words(self, "normals.adapter")
        each_once = len(self.axes) == 3 and {axis[-1:] for axis in self.axes} == set("xyz")
        known = not set(self.axes) - set(_AXES)
        allowed = f"three of {', '.join(_AXES)}, one for each axis"
        refuse_unless(each_once and known, "normals.adapter.axes", list(self.axes), allowed)

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) with canonical = matrix @ channels."""
        result = np.zeros((3, 3), dtype=np.float32)
        for channel, axis in enumerate(self.axes):
            result["xyz".index(axis[1]), channel] = -1.0 if axis[0] == "-" else 1.0
        return result


ADAPTERS: dict[NormalNetwork, NormalAdapter] = {
    # Axes as the authors say: x left, y up, z at the camera (Stable-X/StableNormal issue 18). Range and sizes assumed.
    "stablenormal": NormalAdapter(axes=("-x", "-y", "-z"), mean=(0.5,) * 3, std=(0.5,) * 3, multiple=64),
    # Axes as the author says: x right, y down, z forward, but outward, a wall that faces the camera is (0, 0, 1): all
    # three turned (baegwangbin/DSINE issues 8 and 12).
    "dsine": NormalAdapter(axes=("-x", "-y", "-z"), mean=IMAGENET_MEAN, std=IMAGENET_STD, intrinsics="intrins"),
    # (n + 1) / 2, x right, y down, as the author says (EPFL-VILAB/omnidata issue 13). Of z he says "at the camera", yet
    # the network gives -0.81 for a wall ahead (measured in maturk/dn-splatter issue 9) and MonoSDF uses it unturned.
    "omnidata": NormalAdapter(unit_range=True, fit="stretch", size=384),
    # The published export normalises inside, wants 0..255 and has its confidence apart (YvanYin/Metric3D issue 117).
    # Order x, y, z and 255 minus the usual colours, as the authors say (issue 70), so z forward; x right, y down as in
    # facebookresearch/sapiens issue 50.
    "metric3d": NormalAdapter(input="pixel_values", output="predicted_normal", std=(1 / 255,) * 3, fit="pad"),
}
"""By name of the registry. A network of another family: set every field of ``normals.adapter``."""
