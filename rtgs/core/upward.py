"""Which way is up in the world of some cameras."""

from __future__ import annotations

import numpy as np

_SPREAD = 0.02  # of the right axes: below it their directions span no plane whose normal could be up


def find_up(rotations: np.ndarray) -> tuple[np.ndarray, str]:
    """The upward direction (3,) in the world of cameras (N, 3, 3; world to camera), and how it was found.

    People hold cameras level: the right axes of all photos lie in the horizontal plane, whatever their pitch, so up is
    the direction they span least. Where they hardly differ (all photos from one side) the mean of the cameras' own up.
    """
    own_up = -rotations[:, 1].mean(axis=0)
    values, vectors = np.linalg.eigh(rotations[:, 0].T @ rotations[:, 0] / len(rotations))
    if values[1] < _SPREAD or values[1] < 4 * values[0]:
        why = "mean of the cameras' up axes (their right axes are nearly parallel, or cameras were tilted)"
        return _unit(own_up), why
    up = vectors[:, 0]
    return _unit(up if up @ own_up >= 0 else -up), "the direction across which all photos lie level"


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
