"""How good a reconstruction is, in numbers, in words, and in a picture of what the cameras cover."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rtgs.core.records import read_record
from rtgs.prepare.poses.world import WorldChange
from rtgs.prepare.settings import SfmSettings
from rtgs.scenes.capture import list_some

REPORT_FILE = "sfm.json"
PICTURE_FILE = "coverage.png"
_LINK = 2.0  # times matching.min_inliers: verified matches that join two photos to one group
_GROUP_SHARE = 0.15  # of the photos: a group that counts as a scene of its own
_FEW_KEYPOINTS = 600
_HIGH_ERROR = 1.5  # pixels
_SHORT_TRACK = 3.0
_TURNING = 0.5  # of the pairs


@dataclass(frozen=True)
class SfmReport:
    """Quality of the poses found for a folder of photos or a video. Written as ``sfm.json``."""

    photos: int
    registered: int
    missing: tuple[str, ...]  # photos without a pose
    models: tuple[int, ...]  # photos in each of COLMAP's models; the first is kept
    points: int
    reprojection_error: float  # pixels, mean over points
    track_length: float  # photos that see a point, mean
    observations: float  # points a photo sees, mean
    azimuth_gap: float  # degrees: widest angle around the vertical without a camera
    cameras: tuple[str, ...]  # model, size and parameters of each lens before undistortion
    strategy: str  # how pairs were chosen
    pairs: int
    seconds: dict[str, float]  # by stage
    world: WorldChange
    advice: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()  # what was left out, chosen or noticed before
    observed: dict[str, int] = field(default_factory=dict)  # points each registered photo sees

    @property
    def share(self) -> float:
        """Registered photos over all."""
        return self.registered / max(self.photos, 1)

    def __str__(self) -> str:
        return (
            f"{self.registered} of {self.photos} photos registered, {self.points} points, reprojection error "
            f"{self.reprojection_error:.2f} px, each point seen in {self.track_length:.1f} photos, each photo sees "
            f"{self.observations:.0f} points, widest gap around the scene {self.azimuth_gap:.0f} degrees"
        )

    def write(self, folder: Path) -> None:
        """Write ``sfm.json``."""
        (folder / REPORT_FILE).write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")

    @staticmethod
    def read(folder: Path) -> SfmReport:
        """Read what :meth:`write` wrote.

        Raises:
            RtgsError: it is missing or damaged.
        """
        return read_record(SfmReport, folder / REPORT_FILE)

    def with_world(self, world: WorldChange) -> SfmReport:
        """The same report with another change of frame."""
        return SfmReport(**{**self.__dict__, "world": world})


def registered_images(model: Any) -> list[Any]:
    """Images of a ``pycolmap.Reconstruction`` that have a pose, in name order."""
    return sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)


def camera_arrays(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotations (N, 3, 3) and translations (N, 3) of the registered images, in name order."""
    matrices = np.array([image.cam_from_world().matrix() for image in registered_images(model)])
    return matrices[:, :, :3], matrices[:, :, 3]


def point_array(model: Any) -> np.ndarray:
    """(P, 3) points in ascending id."""
    return np.array([model.points3D[key].xyz for key in sorted(model.points3D)]).reshape(-1, 3)


def seen_depths(model: Any) -> np.ndarray:
    """Depth of every point in every photo that sees it."""
    depths = []
    for image in registered_images(model):
        matrix = image.cam_from_world().matrix()
        ids = [point.point3D_id for point in image.get_observation_points2D()]
        if ids:
            positions = np.array([model.points3D[key].xyz for key in ids])
            depths.append(positions @ matrix[2, :3] + matrix[2, 3])
    return np.concatenate(depths) if depths else np.zeros(0)


def azimuth_gap(centers: np.ndarray, middle: np.ndarray) -> float:
    """Widest angle in degrees around +z, seen from ``middle`` (3,), in which no camera of (N, 3) stands."""
    around = centers[:, :2] - middle[:2]
    around = around[np.linalg.norm(around, axis=1) > 1e-9]
    if len(around) < 2:
        return 360.0
    angles = np.sort(np.degrees(np.arctan2(around[:, 1], around[:, 0])))
    return float(np.diff(np.append(angles, angles[0] + 360)).max())


def groups_of(counts: np.ndarray, least: float) -> list[list[int]]:
    """Photos joined by at least ``least`` verified matches (N, N), largest group first."""
    from scipy.sparse.csgraph import connected_components

    _, labels = connected_components(counts >= least, directed=False)
    groups = [np.flatnonzero(labels == label).tolist() for label in np.unique(labels)]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


@dataclass(frozen=True)
class Evidence:
    """What advice is drawn from."""

    names: tuple[str, ...]
    registered: frozenset[str]
    counts: np.ndarray  # (N, N) verified matches
    keypoints: np.ndarray  # (N,)
    turning: float  # share of the pairs without parallax
    video: bool


def advise(evidence: Evidence, settings: SfmSettings, error: float = 0.0, track: float = _SHORT_TRACK) -> list[str]:
    """Plain words on what is wrong with the photos, most telling first; empty when all is well."""
    names, total = evidence.names, len(evidence.names)
    advice: list[str] = []
    groups = groups_of(evidence.counts, _LINK * settings.matching.min_inliers)
    large = [group for group in groups if len(group) >= max(3, _GROUP_SHARE * total)]
    placed = [sum(names[index] in evidence.registered for index in group) for group in large]
    if len(large) > 1 and any(2 * count < len(group) for count, group in zip(placed, large)):
        listed = "; ".join(f"{len(group)} photos ({names[group[0]]} ... {names[group[-1]]})" for group in large[:4])
        advice.append(
            f"the photos form {len(large)} groups that share no view: {listed}. If these are different scenes, put "
            "each into a folder of its own; if it is one scene, take photos that lead over from one group to the other"
        )
    single = [names[group[0]] for group in groups if len(group) == 1 and total > 1]
    lonely = [name for name in single if name not in evidence.registered]
    if lonely:
        advice.append(
            f"{len(lonely)} photos match no other ({list_some(lonely, 6)}): blurred, of something else, or too far "
            "from the others; each photo should show at least 60 % of what another one shows"
        )
    poor = [name for name, count in zip(names, evidence.keypoints) if count < _FEW_KEYPOINTS]
    if len(poor) > 0.2 * total:
        advice.append(
            f"{len(poor)} photos have fewer than {_FEW_KEYPOINTS} features ({list_some(poor, 6)}): more light, sharper "
            "photos, or something with texture (a newspaper, a patterned cloth) beside a plain or glassy object; "
            "sfm=thorough looks for weaker features"
        )
    if evidence.turning > _TURNING and len(evidence.registered) < settings.good_registered * total:
        advice.append(
            f"{evidence.turning:.0%} of the matching pairs show no parallax: the camera turned on the spot or the "
            "scene is one plane; walk sideways around the scene"
        )
    left = set(names) - evidence.registered - set(lonely)
    if left and len(evidence.registered) < settings.good_registered * total and len(advice) == 0:
        advice.append(
            f"{len(left)} photos match others and still found no place ({list_some(sorted(left), 6)}): reflections or "
            "repeated patterns may have misled the search; try sfm=thorough, or masks in ignore/ over what moves"
        )
    if evidence.registered and error > _HIGH_ERROR:
        advice.append(
            f"the reprojection error of {error:.1f} px is high: something moved, or zoom and focus changed between "
            "photos"
        )
    if evidence.registered and track < _SHORT_TRACK:
        advice.append(f"points are seen in {track:.1f} photos only: take photos closer together")
    return advice


def draw_coverage(model: Any, missing: Sequence[str], counts: np.ndarray, path: Path) -> None:
    """The scene from above (points, cameras, what they look at) beside the matrix of matches, as PNG.

    ``model`` is in the final frame, +z up where settings ask for it.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rotations, translations = camera_arrays(model)
    centers = -np.einsum("nji,nj->ni", rotations, translations)
    points = point_array(model)
    observed = [image.num_points3D for image in registered_images(model)]
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    above, matches = figure.subplots(1, 2)
    step = max(1, len(points) // 5000)
    above.scatter(points[::step, 0], points[::step, 1], s=1, c="0.7", linewidths=0)
    arrow = 0.15 * float(np.linalg.norm(centers[:, :2] - np.median(points[:, :2], axis=0), axis=1).mean() + 1e-9)
    axes = rotations[:, 2, :2] * arrow
    shown = above.scatter(centers[:, 0], centers[:, 1], c=observed, cmap="viridis", s=18, zorder=3)
    above.quiver(
        centers[:, 0], centers[:, 1], axes[:, 0], axes[:, 1], angles="xy", scale_units="xy", scale=1, width=2e-3
    )
    figure.colorbar(shown, ax=above, label="points the photo sees")
    shown_area = np.concatenate([centers[:, :2], np.percentile(points[:, :2], (5, 95), axis=0)])
    low, high = shown_area.min(axis=0) - arrow, shown_area.max(axis=0) + arrow
    middle, reach = (low + high) / 2, float((high - low).max()) / 2
    above.set_xlim(middle[0] - reach, middle[0] + reach)
    above.set_ylim(middle[1] - reach, middle[1] + reach)
    above.set_aspect("equal")
    above.set_title(f"from above: {len(centers)} cameras, {len(missing)} photos without a pose")
    picture = matches.imshow(np.log10(1 + counts), cmap="magma", interpolation="nearest")
    figure.colorbar(picture, ax=matches, label="verified matches, log10(1 + n)")
    matches.set_title("matches between photos, in name order")
    canvas.print_png(str(path))
