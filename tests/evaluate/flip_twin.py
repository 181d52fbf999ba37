"""LDR-FLIP in numpy, written from its paper (Andersson et al. 2020), for comparison with the package that is used."""

from __future__ import annotations

import math

import numpy as np

from rtgs.evaluate.flip import PIXELS_PER_DEGREE

WHITE = np.array([0.950428545, 1.0, 1.088900371])  # D65
XYZ = np.array([[10135552, 8788810, 4435075], [2613072, 8788810, 887015], [1425312, 8788810, 70074185]])
XYZ = XYZ / np.array([[24577794], [12288897], [73733382]])
SENSITIVITY = (  # (a, b) of sums of Gaussians: lightness, red to green, blue to yellow (section 4.1)
    ((1.0, 0.0047),),
    ((1.0, 0.0053),),
    ((34.1, 0.04), (13.5, 0.025)),
)
EDGE_WIDTH = 0.082  # degrees between the peaks of the edge detector (section 4.2)


def linear(color: np.ndarray) -> np.ndarray:
    """sRGB decoded."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def hunt_lab(light: np.ndarray) -> np.ndarray:
    """(3, ...) linear light to L*a*b* whose a* and b* fade with lightness (section 4.1)."""
    ratio = np.tensordot(XYZ, light, 1) / WHITE.reshape(3, *(1,) * (light.ndim - 1))
    edge = 6 / 29
    x, y, z = np.where(ratio > edge**3, np.cbrt(ratio), ratio / (3 * edge**2) + 4 / 29)
    lightness = 116 * y - 16
    return np.stack([lightness, 0.01 * lightness * 500 * (x - y), 0.01 * lightness * 200 * (y - z)])


def color_difference(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """HyAB of two pictures in :func:`hunt_lab` to the power 0.7, in [0, 1]: below 0.4 of the largest it takes up
    0.95 (section 4.1)."""

    def hyab(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        difference = a - b
        return (np.abs(difference[0]) + np.hypot(difference[1], difference[2])) ** 0.7

    green, blue = (hunt_lab(np.eye(3)[channel]) for channel in (1, 2))
    largest, found = hyab(green, blue), hyab(one, other)
    knee = 0.4 * largest
    return np.where(found < knee, 0.95 * found / knee, 0.95 + 0.05 * (found - knee) / (largest - knee))


def flip_twin(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(H, W) FLIP of two (3, H, W) sRGB pictures."""
    (one, edges), (other, others) = (_seen(linear(picture)) for picture in (image, target))
    feature = np.max([np.abs(a - b) for a, b in zip(edges, others, strict=True)], axis=0)
    return color_difference(one, other) ** (1 - np.sqrt(feature / math.sqrt(2)))


def _seen(light: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """A picture as the eye blurs it, in :func:`hunt_lab`, and how strong its edges and points are."""
    x, y, z = np.tensordot(XYZ, light, 1) / WHITE[:, None, None]
    opponent = (116 * y - 16, 500 * (x - y), 200 * (y - z))
    blurred = [_filtered(channel, _sensitivity(terms)) for channel, terms in zip(opponent, SENSITIVITY, strict=True)]
    y = (blurred[0] + 16) / 116
    tristimulus = np.stack([y + blurred[1] / 500, y, y - blurred[2] / 200]) * WHITE[:, None, None]
    seen = np.tensordot(np.linalg.inv(XYZ), tristimulus, 1).clip(0, 1)
    grey = (opponent[0] + 16) / 116
    return hunt_lab(seen), [
        np.hypot(*(_filtered(grey, each) for each in (kernel, kernel.T))) for kernel in _detectors()
    ]


def _sensitivity(terms: tuple[tuple[float, float], ...]) -> np.ndarray:
    reach = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * PIXELS_PER_DEGREE)  # of the widest
    along = np.arange(-reach, reach + 1) / PIXELS_PER_DEGREE
    square = along[:, None] ** 2 + along**2
    kernel = np.sum([a * math.sqrt(math.pi / b) * np.exp(-(math.pi**2) * square / b) for a, b in terms], axis=0)
    return kernel / kernel.sum()


def _detectors() -> tuple[np.ndarray, np.ndarray]:
    """First and second derivative of a Gaussian across; their positive and negative weights have sums 1 and -1."""
    deviation = 0.5 * EDGE_WIDTH * PIXELS_PER_DEGREE
    along = np.arange(-math.ceil(3 * deviation), math.ceil(3 * deviation) + 1)
    blob = np.exp(-(along[:, None] ** 2 + along**2) / (2 * deviation**2))

    def balanced(kernel: np.ndarray) -> np.ndarray:
        return np.where(kernel > 0, kernel / kernel[kernel > 0].sum(), -kernel / kernel[kernel < 0].sum())

    return balanced(-along * blob), balanced((along**2 / deviation**2 - 1) * blob)


def _filtered(picture: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Beyond its border a picture goes on as its border pixels."""
    reach = len(kernel) // 2
    padded = np.pad(picture, reach, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape)
    return np.einsum("ijkl,kl->ij", windows, kernel)
