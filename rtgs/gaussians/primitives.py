"""What surfels and ellipsoids have in common: a structure of arrays of raw parameters, one row a Gaussian.

Optimiser, density control, checkpoints and sets go by these names and row counts. A kind of Gaussian adds its shape;
any kind may hold channels besides (``rtgs.gaussians.channels``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import torch
from torch import Tensor

from rtgs.gaussians.channels import Channel, check_channels

PARAMETERS = ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest")  # what every Gaussian has


@dataclass
class Gaussians:
    """N Gaussians. Raw (unconstrained) parameters (method.md 2), and channels by name.

    ``gaussians["means"]`` is the tensor of that name, of a parameter or of a channel.

    Raises:
        ValueError: ``raw`` does not hold exactly the declared ``channels``, or they do not fit together.
    """

    axis_count: ClassVar[int]  # S: scales a Gaussian has

    means: Tensor  # (N, 3) world
    log_scales: Tensor  # (N, S) log of the standard deviations along the axes, world units
    quaternions: Tensor  # (N, 4) w, x, y, z, any length; axes are the columns of the rotation
    opacity_logits: Tensor  # (N,)
    sh_dc: Tensor  # (N, 3) degree-0 SH coefficients; colour = max(0, 0.5 + sum SH)
    sh_rest: Tensor  # (N, K, 3), K = (degree + 1)^2 - 1 in {0, 3, 8, 15}
    channels: tuple[Channel, ...] = ()  # in the order in which they are composited
    raw: dict[str, Tensor] = field(default_factory=dict)  # of each channel (N, *its shape)

    def __post_init__(self) -> None:
        check_channels(self.channels, PARAMETERS)
        if self.raw.keys() != {channel.name for channel in self.channels}:
            declared = ", ".join(channel.name for channel in self.channels) or "none"
            raise ValueError(f"values of the channels {', '.join(self.raw) or 'none'}, but declared are {declared}")
        for channel in self.channels:
            self._check_row(channel, self.raw[channel.name])
            if (rows := len(self.raw[channel.name])) != len(self):
                raise ValueError(f"channel {channel.name} has {rows} rows, but there are {len(self)} means")

    def __len__(self) -> int:
        return self.means.shape[0]

    def __contains__(self, name: str) -> bool:
        return name in PARAMETERS or name in self.raw

    def __getitem__(self, name: str) -> Tensor:
        """The raw tensor of a parameter or a channel.

        Raises:
            KeyError: there is none of this name.
        """
        if name in PARAMETERS:
            return getattr(self, name)
        if name not in self.raw:
            self._check_name(name)
        return self.raw[name]

    def __setitem__(self, name: str, tensor: Tensor) -> None:
        """Another tensor for a parameter or a channel that is there; whoever changes N sets all of them.

        Raises:
            KeyError: there is none of this name.
            ValueError: rows of a channel have another shape.
        """
        self._check_name(name)
        if name in PARAMETERS:
            setattr(self, name, tensor)
        else:
            self._check_row(self.channel(name), tensor)
            self.raw[name] = tensor

    def _check_name(self, name: str) -> None:
        if name not in self:
            raise KeyError(f"{type(self).__name__} have no {name!r}; they have {', '.join(self.names)}")

    @staticmethod
    def _check_row(channel: Channel, tensor: Tensor) -> None:
        if tuple(tensor.shape[1:]) != channel.shape or not tensor.ndim:
            expected = ", ".join(("N", *map(str, channel.shape)))
            raise ValueError(f"channel {channel.name} must be ({expected}), got {tuple(tensor.shape)}")

    def channel(self, name: str) -> Channel:
        """The declared channel of this name.

        Raises
        ------
        KeyError
            There is none.
        """
        for channel in self.channels:
            if channel.name == name:
                return channel
        held = ", ".join(channel.name for channel in self.channels) or "none"
        raise KeyError(f"{type(self).__name__} have no channel {name!r}; they have {held}")

    def activated(self, name: str) -> Tensor:
        """(N, *shape) activated values of a channel, differentiable."""
        return self.channel(name).activate(self[name])

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters, then of the channels as declared."""
        return (*PARAMETERS, *(channel.name for channel in self.channels))

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """(name, tensor) of every parameter, then of every channel, in the order of :attr:`names`."""
        for name in PARAMETERS:
            yield name, getattr(self, name)
        for channel in self.channels:
            yield channel.name, self.raw[channel.name]

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor], channels: tuple[Channel, ...] = ()) -> Self:
        """Gaussians of named tensors (names of others are left out).

        Raises
        ------
        KeyError
            A parameter or a channel is missing.
        """
        parameters = {name: tensors[name] for name in PARAMETERS}
        return cls(**parameters, channels=channels, raw={channel.name: tensors[channel.name] for channel in channels})

    def like(self, tensors: Mapping[str, Tensor]) -> Self:
        """The same kind with the same channels, of other tensors: one for each of :attr:`names`."""
        return type(self).of(tensors, self.channels)

    def with_channels(self, *channels: Channel) -> Self:
        """The same Gaussians (the same tensors) with these channels besides, at their initial values."""
        rows = {channel.name: channel.initial_rows(len(self), self.means.dtype) for channel in channels}
        return type(self).of({**rows, **dict(self.items())}, (*self.channels, *channels))

    def without_channels(self, *names: str) -> Self:
        """The same Gaussians (the same tensors) without the channels of these names, as far as they are there."""
        kept = tuple(channel for channel in self.channels if channel.name not in names)
        return type(self).of(dict(self.items()), kept)

    @property
    def sh_degree(self) -> int:
        """Largest SH degree the coefficients hold."""
        return {0: 0, 3: 1, 8: 2, 15: 3}[self.sh_rest.shape[1]]

    def requires_grad_(self, flag: bool = True) -> Self:
        for _, tensor in self.items():
            tensor.requires_grad_(flag)
        return self

    def detached(self) -> Self:
        """A copy that shares no memory and no graph."""
        return self.like({name: tensor.detach().clone() for name, tensor in self.items()})

    def axes(self) -> Tensor:
        """(N, S, 3) unit axes of the Gaussian, world: one for each scale."""
        raise TypeError(f"{type(self).__name__} has no axes: use a kind of Gaussian, Surfels or Ellipsoids")

    @torch.no_grad()
    def deviations(self) -> Tensor:
        """(N, S, 3) axes times their standard deviations, world: a standard normal (N, S) of them is a sample."""
        scales = self.log_scales.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).exp()
        return scales[..., None] * self.axes()


SHORTEST = 1e-12  # a vector whose largest component is at most this counts as zero
LOG_SCALE_LIMIT = 40.0  # log-scales act within +-this: scales, their squares and inverses stay normal float32 numbers


def unit_or_zero(vectors: Tensor) -> Tensor:
    """(N, C) vectors divided by their length, without overflow; those too short become zero and pass no gradient."""
    largest = vectors.detach().abs().amax(-1, keepdim=True)  # cancels: no gradient by it
    long = largest > SHORTEST
    scaled = torch.where(long, vectors, 0.0) / torch.where(long, largest, 1.0)
    square = (scaled * scaled).sum(-1, keepdim=True)
    return scaled * torch.where(long, square, 1.0).rsqrt()


def tangents(quaternions: Tensor) -> tuple[Tensor, Tensor]:
    """Columns 0 and 1 of the rotations of (N, 4) quaternions of any length; a zero quaternion is the identity."""
    w, x, y, z = unit_or_zero(quaternions).unbind(-1)
    tangent_u = torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)), -1)
    tangent_v = torch.stack((2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)), -1)
    return tangent_u, tangent_v


def in_sphere(points: Tensor, center: Sequence[float], radius: float) -> Tensor:
    """(N,) bool: points (N, 3) in or on a sphere, world."""
    return (points - torch.tensor(center, dtype=points.dtype)).square().sum(1) <= radius**2
