"""Channels: what a set of Gaussians holds for each row besides shape, opacity and colour, by name.

A channel is trained and, unless it says otherwise, composited like a colour. The set holds its raw values; an
activation from the table :data:`ACTIVATIONS` makes of them what a renderer composites. Optimiser, density control,
checkpoints and PLY files go by :attr:`Channel.name`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import torch
from torch import Tensor

MAX_CHANNELS = 32  # composited of one Gaussian: its colour (3), its channels, and normals that are drawn as a feature
COLOR_COLUMNS = 3

ActivationName = Literal["sigmoid", "log_floor", "linear_floor", "identity", "exp", "softplus", "tanh"]


@dataclass(frozen=True)
class Activation:
    """A strictly increasing function of raw values, differentiable in any dtype, and its inverse.

    ``floor`` is the lowest activated value of the two functions that have one; the others do not read it.
    """

    forward: Callable[[Tensor, float], Tensor]  # (raw, floor)
    inverse: Callable[[float, float], float]  # (activated, floor), float64
    limits: Callable[[float], tuple[float, float]]  # of the activated values at a floor, ends excluded
    has_floor: bool = False
    logit: bool = False  # the raw value is a logit, like that of an opacity: it may share the opacity's bounds


@dataclass(frozen=True)
class Channel:
    """One named channel of a set of Gaussians.

    Raises:
        ValueError: a value does not fit the activation, or bounds at which the activation is not finite in float32.
    """

    name: str  # of the raw parameter; in a PLY file without the suffix "_logits"
    initial: float  # activated value of every column of a new row
    activation: ActivationName
    shape: tuple[int, ...] = ()  # of one row: () is stored as (N,), (C,) as (N, C)
    floor: float = 0.0  # lowest activated value, exclusive: of log_floor and linear_floor alone
    rate: float | None = None  # Adam's; None: the optimiser's setting of this name
    # Lowest and highest raw value, clamped to after every step. None: those of an opacity's logit; of logits alone.
    bounds: tuple[float, float] | None = None
    composited: bool = True  # False: no column of the image, but what a part makes its columns of

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"channel {self.name!r}: the name must be an identifier")
        if len(self.shape) > 1 or any(columns < 1 for columns in self.shape):
            raise ValueError(f"channel {self.name}: shape {self.shape} must be () or (columns,)")
        if self.activation not in ACTIVATIONS:
            raise ValueError(f"channel {self.name}: activation {self.activation!r} is none of {', '.join(ACTIVATIONS)}")
        if self.rate is not None and not (math.isfinite(self.rate) and self.rate >= 0):
            raise ValueError(f"channel {self.name}: rate {self.rate} must be finite and at least 0")
        self._check_values()

    def _check_values(self) -> None:
        table = ACTIVATIONS[self.activation]
        if not (0 < self.floor < 1 if table.has_floor else self.floor == 0):
            wanted = "be between 0 and 1" if table.has_floor else f"be 0: {self.activation} has none"
            raise ValueError(f"channel {self.name}: floor {self.floor} must {wanted}")
        low, high = table.limits(self.floor)
        if not low < self.initial < high:
            raise ValueError(f"channel {self.name}: initial {self.initial} must be between {low:g} and {high:g}")
        if self.bounds is None:
            if not table.logit:
                raise ValueError(f"channel {self.name}: {self.activation} needs bounds of its raw value")
            return
        low, high = self.bounds
        ends = self.activate(torch.tensor([low, high], dtype=torch.float32))
        if not (low < high and bool(torch.isfinite(ends).all())):
            raise ValueError(f"channel {self.name}: bounds {self.bounds} must be ordered, and {self.activation} finite")
        if not low <= self.initial_raw <= high:
            raise ValueError(
                f"channel {self.name}: initial {self.initial} has the raw value {self.initial_raw:g}, "
                f"which is not within the bounds {self.bounds}"
            )

    @property
    def columns(self) -> int:
        """How many columns one row has."""
        return self.shape[0] if self.shape else 1

    @property
    def properties(self) -> tuple[str, ...]:
        """Names of its columns in a PLY file: ``gloss`` of a channel gloss_logits, ``gloss_0 ..`` if it has a shape."""
        name = self.name.removesuffix("_logits")
        return tuple(f"{name}_{k}" for k in range(self.columns)) if self.shape else (name,)

    @property
    def initial_raw(self) -> float:
        """The raw value of :attr:`initial`."""
        return ACTIVATIONS[self.activation].inverse(self.initial, self.floor)

    def initial_rows(self, count: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """(count, *shape) raw values of new rows."""
        return torch.full((count, *self.shape), self.initial_raw, dtype=dtype)

    def activate(self, raw: Tensor) -> Tensor:
        """Activated values of ``raw``, same shape, any dtype, differentiable."""
        return ACTIVATIONS[self.activation].forward(raw, self.floor)


def check_channels(channels: tuple[Channel, ...], parameters: tuple[str, ...]) -> None:
    """Refuse channels that one set cannot hold together, next to its ``parameters``.

    Raises:
        ValueError: a name occurs twice, or they are too many to composite beside the colour.
    """
    names = [*parameters, *(channel.name for channel in channels)]
    if double := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"parameters named twice: {', '.join(sorted(double))}")
    columns = COLOR_COLUMNS + sum(channel.columns for channel in channels if channel.composited)
    if columns > MAX_CHANNELS:
        raise ValueError(f"a colour and channels of {columns - COLOR_COLUMNS} columns: at most {MAX_CHANNELS} in all")


def logit(share: float) -> float:
    """The raw value of an opacity, or of any sigmoid, in (0, 1)."""
    return math.log(share / (1 - share))


def _log_floor(raw: Tensor, floor: float) -> Tensor:
    """floor^(1 - sigmoid): equal steps of the raw value are equal ratios of the activated one."""
    return ((1 - raw.sigmoid()) * math.log(floor)).exp()


def _linear_floor(raw: Tensor, floor: float) -> Tensor:
    return floor + (1 - floor) * raw.sigmoid()


def _softplus(raw: Tensor, floor: float) -> Tensor:
    return torch.logaddexp(raw, torch.zeros_like(raw))  # torch's own softplus is not exact above 20


def _everywhere(floor: float) -> tuple[float, float]:
    return -math.inf, math.inf


def _positive(floor: float) -> tuple[float, float]:
    return 0.0, math.inf


ACTIVATIONS: Mapping[str, Activation] = MappingProxyType(
    {
        "sigmoid": Activation(
            lambda raw, floor: raw.sigmoid(), lambda value, floor: logit(value), lambda floor: (0.0, 1.0), logit=True
        ),
        "log_floor": Activation(
            _log_floor,
            lambda value, floor: logit(1 - math.log(value) / math.log(floor)),
            lambda floor: (floor, 1.0),
            has_floor=True,
            logit=True,
        ),
        "linear_floor": Activation(
            _linear_floor,
            lambda value, floor: logit((value - floor) / (1 - floor)),
            lambda floor: (floor, 1.0),
            has_floor=True,
            logit=True,
        ),
        "identity": Activation(lambda raw, floor: raw, lambda value, floor: value, _everywhere),
        "exp": Activation(lambda raw, floor: raw.exp(), lambda value, floor: math.log(value), _positive),
        "softplus": Activation(_softplus, lambda value, floor: value + math.log(-math.expm1(-value)), _positive),
        "tanh": Activation(
            lambda raw, floor: raw.tanh(), lambda value, floor: math.atanh(value), lambda floor: (-1.0, 1.0)
        ),
    }
)
