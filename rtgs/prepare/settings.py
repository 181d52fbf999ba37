"""What the preparation of a capture can be told: the schema of the ``sfm`` and ``normals`` config groups.

Numbers without a source are COLMAP's defaults (``pycolmap.IncrementalPipelineOptions`` and its siblings print them).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from rtgs.core.errors import RtgsError
from rtgs.core.refuse import refuse_bad_counts, refuse_below, refuse_outside, refuse_unknown_words, refuse_unless
from rtgs.prepare.normals.adapters import ADAPTERS, NormalAdapter, NormalNetwork

Use = Literal["auto", "always", "never"]
FeatureKind = Literal["sift", "aliked_n16rot", "aliked_n32"]
Pairs = Literal["auto", "exhaustive", "sequential", "retrieval"]
Mapper = Literal["incremental", "global"]
NormalModel = Literal[NormalNetwork, "custom"]


@dataclass(frozen=True)
class VideoSettings:
    """How frames are taken out of a video."""

    shift: float = 0.05
    """Motion between two chosen frames, in long sides of the picture (median of tracked corners). 0.05 of 800 pixels
    is 40: neighbours overlap by well over 80 %, which SIFT matching likes."""
    min_frames: int = 20
    """A slow video gives at least this many (or all it has)."""
    max_frames: int = 150
    """And never more; beyond it the frames lie farther apart."""
    candidates_per_second: float = 8.0
    """Frames that are looked at; of those between two choices the sharpest is taken."""
    min_motion: float = 0.1
    """A video whose whole motion is less, in long sides, is refused: no poses without parallax."""
    max_side: int | None = None
    """Long side of the written frames. None: the video's own."""
    jpeg_quality: int = 95
    """Of the written frames."""

    def __post_init__(self) -> None:
        refuse_bad_counts(self, "sfm.video", min_frames=1, max_side=32, jpeg_quality=1)
        refuse_outside(self, "sfm.video", 1, 100, "jpeg_quality")
        refuse_outside(self, "sfm.video", 0, math.inf, "candidates_per_second", open_low=True)
        refuse_outside(self, "sfm.video", 0, math.inf, "min_motion")


@dataclass(frozen=True)
class FeatureSettings:
    """Keypoints and descriptors."""

    kind: FeatureKind = "sift"
    """``sift``; ``aliked_n16rot`` and ``aliked_n32`` need COLMAP's model files on this machine."""
    max_side: int = 1600
    """Photos are shrunk to it for the search (COLMAP's quality "medium"; 2400 is "high")."""
    max_features: int = 8192
    affine_shape: bool = False
    """Estimate the affine shape of SIFT keypoints: more matches across wide angles, several times slower."""
    peak_threshold: float = 0.0067
    """Contrast below which a SIFT keypoint does not count; lower finds more on plain walls."""

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "sfm.features")
        refuse_outside(self, "sfm.features", 0, 1, "peak_threshold")


@dataclass(frozen=True)
class MatchingSettings:
    """Which photos are compared, and how strictly."""

    pairs: Pairs = "auto"
    """``exhaustive`` every pair; ``sequential`` neighbours in order, for videos; ``retrieval`` the most similar ones.
    ``auto``: exhaustive up to ``exhaustive_up_to`` photos, beyond it sequential for a video, retrieval for photos."""
    exhaustive_up_to: int = 120
    """7140 pairs, about two minutes at 800 pixels on two cores."""
    neighbours: int = 30
    """Similar photos each photo is compared with (retrieval; a third of it closes the loops of a sequence)."""
    overlap: int = 10
    """Following frames each frame is compared with (sequential), and those at 2, 4, 8 ... frames' distance."""
    words: int = 64
    """Centres of the image signature (VLAD) that retrieval compares; 64 as in Jegou et al. 2010."""
    guided: bool = False
    """Search again along epipolar lines: more matches, slower."""
    min_inliers: int = 15
    """Geometrically verified matches below which a pair is dropped."""
    ransac_error: float = 4.0
    """Pixels."""

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "sfm.matching")
        refuse_bad_counts(self, "sfm.matching")
        refuse_outside(self, "sfm.matching", 0, math.inf, "ransac_error", open_low=True)


@dataclass(frozen=True)
class MappingSettings:
    """From matches to poses and points."""

    mapper: Mapper = "incremental"
    """``incremental``, or ``global`` (GLOMAP): faster on many photos, less patient with few or weak matches."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's name; one camera per picture size and EXIF focal length."""
    focal_factor: float = 1.2
    """Focal length to start from in long sides of the photo, where EXIF says none."""
    init_min_angle: float = 16.0
    """Degrees between the rays of the first pair."""
    init_trials: int = 3
    """Attempts, each with half the demands of the one before (angle and inliers of the first pair, inliers of every
    pose), until one is good: ``enough`` and ``good_error``. The one that places most photos counts, of equals the one
    with most observations. A wide first pair can lead into a wrong model that places every photo: bonsai, at 0.96
    pixels, where the second attempt has 0.31 and half as many points again."""
    enough: float = 0.97
    """Share of the photos that a good attempt places."""
    good_error: float = 0.6
    """Mean reprojection error of a good attempt, pixels at 800 a side; in proportion for other sizes."""
    init_min_inliers: int = 100
    pose_min_inliers: int = 30
    """Points of the model a photo must see to be placed."""
    pose_min_ratio: float = 0.25
    """Share of its matches with the model that must agree with its pose."""
    min_model: int = 3
    """Models of fewer photos do not count."""
    min_points: int = 50
    """Nor do models of fewer points: nothing holds their poses."""
    refine_principal_point: bool = False
    threads: int = 1
    """Of the mapper. One keeps results the same on every machine; large bundle adjustments gain from more."""

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "sfm.mapping")
        refuse_bad_counts(self, "sfm.mapping")
        refuse_outside(self, "sfm.mapping", 0, math.inf, "focal_factor", "good_error", open_low=True)
        refuse_outside(self, "sfm.mapping", 0, 180, "init_min_angle")
        refuse_outside(self, "sfm.mapping", 0, 1, "enough", "pose_min_ratio")


@dataclass(frozen=True)
class WorldSettings:
    """The frame the result is handed over in. The change of frame is recorded and can be undone."""

    up: bool = True
    """Turn the world so that +z is up: the direction across which all photos lie level."""
    view_distance: float = 4.0
    """Scale the world so that the median distance of a camera to the points it sees is this many units: the
    rasteriser's near plane of 0.2 is then a twentieth of it. 0: keep the scale."""
    center: bool = True
    """Move the median of the points to the origin."""


@dataclass(frozen=True)
class SfmSettings:
    """Poses from photos or a video.

    Raises:
        RtgsError: a value outside its documented range.
    """

    use: Use = "auto"
    """``auto``: where the capture has no poses. ``always``: also where it has. ``never``: one without is refused."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    mapping: MappingSettings = field(default_factory=MappingSettings)
    world: WorldSettings = field(default_factory=WorldSettings)
    video: VideoSettings = field(default_factory=VideoSettings)
    ignore_dir: str = "ignore"
    """Folder of masks, named like the photos, whose non-zero regions (people, cars, leaves) give no features."""
    ignore_masks: bool = True
    """The scene's own masks (glass) give no features either: what is seen in glass moves against the scene."""
    min_photos: int = 3
    min_registered: float = 0.25
    """Share of the photos that must find a pose; fewer is a failure."""
    good_registered: float = 0.9
    """Below it the log warns and says what to do."""
    jpeg_quality: int = 95
    """Of the undistorted photos."""
    seed: int = 0

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "sfm")
        refuse_bad_counts(self, "sfm")
        refuse_outside(self, "sfm", 1, 100, "jpeg_quality")
        refuse_outside(self, "sfm", 0, 1, "min_registered", "good_registered")
        for key, value, least in (
            ("features.max_side", self.features.max_side, 64),
            ("features.max_features", self.features.max_features, 100),
            ("matching.neighbours", self.matching.neighbours, 1),
            ("matching.overlap", self.matching.overlap, 1),
            ("matching.words", self.matching.words, 2),
            ("mapping.init_trials", self.mapping.init_trials, 1),
            ("mapping.min_model", self.mapping.min_model, 2),
            ("mapping.min_points", self.mapping.min_points, 1),
            ("mapping.threads", self.mapping.threads, 1),
            ("world.view_distance", self.world.view_distance, 0),
            ("min_photos", self.min_photos, 2),
            ("video.max_frames", self.video.max_frames, 3),
        ):
            refuse_below(f"sfm.{key}", value, least)
        shift = self.video.shift
        refuse_unless(0 < shift < 1, "sfm.video.shift", shift, "between 0 and 1 (long sides)")


@dataclass(frozen=True)
class NormalSettings:
    """Monocular normals for photos that have none.

    Raises:
        RtgsError: a value outside its documented range.
    """

    use: Use = "auto"
    """``auto``: where a loss of the method reads them, none are given, and the network's file is there. ``always``:
    also without such a loss or in place of given ones, and a missing file is an error. ``never``."""
    model: NormalModel = "stablenormal"
    """``stablenormal``, ``dsine``, ``omnidata``, ``metric3d`` (:mod:`rtgs.prepare.normals.adapters` declares what their
    numbers mean), or ``custom``: as ``adapter`` says."""
    file: str = ""
    """ONNX file. Empty: the registered name in the folders of weights (``rtgs weights status``)."""
    sha256: str = ""
    """Digest the file must have; empty: any."""
    axes: tuple[str, ...] = ()
    """Instead of the adapter's axes: what the three channels are in x right, y down, z forward, as [+x,-y,-z]."""
    adapter: NormalAdapter = field(default_factory=NormalAdapter)
    """Of a ``custom`` network."""
    max_side: int = 1024
    """Long side of the stored maps; the import brings them to the size of the views."""
    tile: int = 0
    """Side, in pixels of the stored map, of the overlapping squares that go through the network one by one: finer
    normals of a large photo (raise ``max_side``), and the memory of one tile. 0: the photo as a whole, shrunk to what
    the network takes, which sees more of the scene and is the better guess where surfaces are plain."""
    tile_overlap: float = 0.25
    """Share of a tile that its neighbour sees, too; blended there."""
    check: bool = True
    """Stop when the capture's points say that the axes are declared wrongly."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "axes", tuple(self.axes))
        refuse_unknown_words(self, "normals")
        if self.model == "custom" and not self.file:
            raise RtgsError("normals.model=custom needs normals.file, the ONNX file")
        refuse_below("normals.max_side", self.max_side, 32)
        tile, overlap = self.tile, self.tile_overlap
        refuse_unless(tile == 0 or tile >= 64, "normals.tile", tile, "0 (no tiles) or at least 64 pixels")
        refuse_unless(0 <= overlap <= 0.5, "normals.tile_overlap", overlap, "between 0 and 0.5")

    @property
    def declared(self) -> NormalAdapter:
        """The adapter in force."""
        adapter = self.adapter if self.model == "custom" else ADAPTERS[self.model]
        return replace(adapter, axes=self.axes) if self.axes else adapter
