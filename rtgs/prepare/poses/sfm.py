"""Poses from photos: COLMAP's features, matches and mappers (pycolmap), in pieces that tell how far they are.

The same photos, settings and pycolmap give the same model: images are registered in name order before features are
searched (else their ids depend on which thread is first), every RANSAC has the seed of the settings.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.poses import pairs
from rtgs.prepare.poses.photos import PhotoSet
from rtgs.prepare.progress import Say, Ticker
from rtgs.prepare.settings import SfmSettings

_PHOTOS_PER_CALL = 8  # features are searched in this many photos between two looks at the clock
_PAIRS_PER_CALL = 400  # the matcher reads descriptors again in each call: fewer calls are faster
_SAMPLES_PER_PHOTO = 400  # descriptors each photo gives to the words of retrieval
_MIN_POSE_INLIERS = 10  # points a pose rests on at the very least
_LOG_ERRORS = 2  # glog level: COLMAP itself stays silent below errors


@dataclass(frozen=True)
class Workplace:
    """Where a reconstruction is at work; what is finished in it is not done again."""

    folder: Path

    @property
    def photos(self) -> Path:
        """Upright pictures under the names of the model."""
        return self.folder / "photos"

    @property
    def ignored(self) -> Path:
        """COLMAP's masks of what gives no features."""
        return self.folder / "ignored"

    @property
    def database(self) -> Path:
        """COLMAP's database of features and matches."""
        return self.folder / "database.db"

    @property
    def models(self) -> Path:
        """Folder of the reconstructions."""
        return self.folder / "models"


@dataclass(frozen=True)
class Reconstructed:
    """What came of it: COLMAP's models, most photos first, and the seconds of each stage."""

    models: tuple[Any, ...]  # pycolmap.Reconstruction
    strategy: str  # how pairs were chosen, and why
    pairs: int
    seconds: dict[str, float]


@contextmanager
def quiet() -> Iterator[None]:
    """COLMAP says only what went wrong."""
    from rtgs.core.colmap import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = _LOG_ERRORS
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def reconstruct(
    photos: PhotoSet, video: bool, place: Workplace, settings: SfmSettings, threads: int, say: Say
) -> Reconstructed:
    """Search poses for the photos laid out in ``place``.

    Raises:
        PrepareError: a model file of the features is missing, or COLMAP failed.
    """
    from rtgs.core.colmap import pycolmap

    pycolmap.set_random_seed(settings.seed)
    _register(photos, place, settings)
    seconds = {"features": _extract(photos, place, settings, threads, say)}
    chosen, strategy = _choose_pairs(photos, video, place, settings)
    say(f"matching {len(chosen)} pairs: {strategy}")
    seconds["matching"] = _match(photos, chosen, place, settings, threads, say)
    models, seconds["mapping"] = _map(photos, place, settings, say)
    return Reconstructed(tuple(models), strategy, len(chosen), seconds)


def _register(photos: PhotoSet, place: Workplace, settings: SfmSettings) -> None:
    """Enter photos in name order, one camera for each size and EXIF focal length."""
    from rtgs.core.colmap import pycolmap

    if place.database.exists():
        with pycolmap.Database.open(str(place.database)) as database:
            if {image.name for image in database.read_all_images()} == set(photos.names):
                return
        place.database.unlink()
    with pycolmap.Database.open(str(place.database)):
        pass
    options = pycolmap.ImageReaderOptions()
    options.camera_model = settings.mapping.camera_model
    options.default_focal_length_factor = settings.mapping.focal_factor
    groups = dict.fromkeys(photo.group for photo in photos.photos)
    for group in groups:
        names = [photo.name for photo in photos.photos if photo.group == group]
        try:
            pycolmap.import_images(str(place.database), str(place.photos), pycolmap.CameraMode.SINGLE, names, options)
        except (RuntimeError, ValueError) as error:
            place.database.unlink()
            raise PrepareError(
                f"COLMAP refuses the photos ({_first_line(error)}): see sfm.mapping.camera_model"
            ) from error


def _extract(photos: PhotoSet, place: Workplace, settings: SfmSettings, threads: int, say: Say) -> float:
    from rtgs.core.colmap import pycolmap

    wanted = settings.features
    options = pycolmap.FeatureExtractionOptions()
    options.type = getattr(pycolmap.FeatureExtractorType, wanted.kind.upper())
    options.max_image_size = wanted.max_side
    options.num_threads = threads
    options.use_gpu = False
    if wanted.kind == "sift":
        options.sift.max_num_features = wanted.max_features
        options.sift.estimate_affine_shape = wanted.affine_shape
        options.sift.peak_threshold = wanted.peak_threshold
    reader = pycolmap.ImageReaderOptions()
    if place.ignored.is_dir():
        reader.mask_path = str(place.ignored)
    ticker = Ticker(say, "features", len(photos.photos))
    for start in range(0, len(photos.photos), _PHOTOS_PER_CALL):
        names = list(photos.names[start : start + _PHOTOS_PER_CALL])
        try:
            pycolmap.extract_features(
                str(place.database),
                str(place.photos),
                image_names=names,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
        except (RuntimeError, ValueError) as error:
            raise PrepareError(
                f"features {wanted.kind} failed on {names[0]} ...: {_first_line(error)}"
                + ("" if wanted.kind == "sift" else "; their model files must be on this machine, or use sift")
            ) from error
        ticker(start + len(names))
    return ticker.took


def _choose_pairs(
    photos: PhotoSet, video: bool, place: Workplace, settings: SfmSettings
) -> tuple[list[tuple[int, int]], str]:
    count, wanted = len(photos.photos), settings.matching
    strategy, why = pairs.choose_strategy(count, video, wanted)
    if strategy == "exhaustive":
        return pairs.exhaustive_pairs(count), f"exhaustive, {why}"
    signatures = _signatures(photos, place, settings)
    if strategy == "retrieval":
        return pairs.retrieval_pairs(signatures, wanted.neighbours), f"retrieval, {why}"
    loops = pairs.retrieval_pairs(signatures, max(1, wanted.neighbours // 3))
    return sorted({*pairs.sequential_pairs(count, wanted.overlap), *loops}), f"sequential with loops, {why}"


def _signatures(photos: PhotoSet, place: Workplace, settings: SfmSettings) -> np.ndarray:
    """(N, D) unit VLAD signatures; one photo's descriptors in memory at a time."""
    from rtgs.core.colmap import pycolmap

    rng = np.random.default_rng(settings.seed)
    with pycolmap.Database.open(str(place.database)) as database:
        numbers = [_image_id(database, name) for name in photos.names]

        def descriptors(number: int) -> np.ndarray:
            data: Any = database.read_descriptors(number).data
            return np.asarray(data)

        samples = []
        for number in numbers:
            data = descriptors(number)
            few = min(len(data), _SAMPLES_PER_PHOTO)
            samples.append(data[rng.choice(len(data), few, replace=False)] if few else data)
        centers = pairs.learn_words(np.concatenate(samples), settings.matching.words, settings.seed)
        return np.stack([pairs.signature(descriptors(number), centers) for number in numbers])


def _match(
    photos: PhotoSet,
    chosen: Sequence[tuple[int, int]],
    place: Workplace,
    settings: SfmSettings,
    threads: int,
    say: Say,
) -> float:
    from rtgs.core.colmap import pycolmap

    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = threads
    options.use_gpu = False
    options.guided_matching = settings.matching.guided
    if settings.features.kind != "sift":
        options.type = pycolmap.FeatureMatcherType.ALIKED_BRUTEFORCE
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = settings.matching.min_inliers
    verification.ransac.max_error = settings.matching.ransac_error
    verification.ransac.random_seed = settings.seed
    pairing = pycolmap.ImportedPairingOptions()
    listed = place.folder / "pairs.txt"
    pairing.match_list_path = str(listed)
    ticker = Ticker(say, "matching pairs", len(chosen))
    for start in range(0, len(chosen), _PAIRS_PER_CALL):
        part = chosen[start : start + _PAIRS_PER_CALL]
        listed.write_text("".join(f"{photos.names[i]} {photos.names[j]}\n" for i, j in part), encoding="utf-8")
        try:
            pycolmap.match_image_pairs(
                str(place.database),
                matching_options=options,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
        except (RuntimeError, ValueError) as error:
            raise PrepareError(f"matching failed: {_first_line(error)}") from error
        ticker(start + len(part))
    return ticker.took


def _map(photos: PhotoSet, place: Workplace, settings: SfmSettings, say: Say) -> tuple[list[Any], float]:
    """COLMAP's models, most photos first, of the best attempt; demands fall until one is good."""
    total = len(photos.photos)
    # Each photo makes the next one dearer, and all of them are adjusted together in the end: no time left is told.
    ticker = Ticker(say, "photos with a pose", total, even=False)
    best: list[Any] = []
    for trial in range(settings.mapping.init_trials):
        if trial:
            found = f"{best[0].num_reg_images() if best else 0} of {total} photos have a pose"
            say(f"{found}: attempt {trial + 1} of {settings.mapping.init_trials}, which demands less, begins anew")
        shutil.rmtree(place.models, ignore_errors=True)
        place.models.mkdir(parents=True)
        if settings.mapping.mapper == "global":
            models = _global(place, settings)
        else:
            models = _incremental(place, settings, 0.5**trial, _Registered(total, ticker, say))
        models = [model for model in models if _counts(model, settings)]
        models.sort(key=_size, reverse=True)
        if models and (not best or _size(models[0]) > _size(best[0])):
            best = models
        if settings.mapping.mapper == "global" or (best and _is_good(best[0], photos, settings)):
            break
    return best, ticker.took


def _counts(model: Any, settings: SfmSettings) -> bool:
    """Is it a model at all? COLMAP also returns photos whose last points it has filtered away."""
    wanted = settings.mapping
    return model.num_reg_images() >= wanted.min_model and model.num_points3D() >= wanted.min_points


def _size(model: Any) -> tuple[int, int]:
    """Photos, then observations: what attempts are compared by."""
    return model.num_reg_images(), model.compute_num_observations()


def _is_good(model: Any, photos: PhotoSet, settings: SfmSettings) -> bool:
    """Is another attempt not worth its time?"""
    wanted = settings.mapping
    longest = max(max(camera.width, camera.height) for camera in model.cameras.values())
    error = model.compute_mean_reprojection_error() * 800 / longest
    return model.num_reg_images() >= wanted.enough * len(photos.photos) and error <= wanted.good_error


class _Registered:
    """Counts the photos of the model that COLMAP is at, and says when another model or the last long step begins."""

    def __init__(self, total: int, ticker: Ticker, say: Say) -> None:
        self._total, self._ticker, self._say = total, ticker, say
        self._models = self._count = 0

    def begin(self) -> None:
        """The first two photos of a model."""
        if self._models:
            self._say(f"{self._count} photos are one model; the others are tried as another one")
        self._models += 1
        self._count = 2

    def add(self) -> None:
        """One more photo."""
        self._count += 1
        self._ticker(self._count)
        if self._count == self._total:
            self._say(f"all {self._total} photos have a pose; they are adjusted together, which takes a while")


def _incremental(place: Workplace, settings: SfmSettings, leniency: float, registered: _Registered) -> list[Any]:
    from rtgs.core.colmap import pycolmap

    wanted = settings.mapping
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = settings.seed
    options.num_threads = options.mapper.num_threads = wanted.threads
    options.min_num_matches = settings.matching.min_inliers
    options.min_model_size = wanted.min_model
    options.ba_refine_principal_point = wanted.refine_principal_point
    options.mapper.init_min_tri_angle = wanted.init_min_angle * leniency
    options.mapper.init_min_num_inliers = max(settings.matching.min_inliers, round(wanted.init_min_inliers * leniency))
    least = max(_MIN_POSE_INLIERS, round(wanted.pose_min_inliers * leniency))
    options.mapper.abs_pose_min_num_inliers = least
    options.mapper.abs_pose_min_inlier_ratio = wanted.pose_min_ratio * leniency
    if leniency < 1:
        options.min_num_matches = min(settings.matching.min_inliers, _MIN_POSE_INLIERS)
    try:
        models = pycolmap.incremental_mapping(
            str(place.database),
            str(place.photos),
            str(place.models),
            options,
            initial_image_pair_callback=registered.begin,
            next_image_callback=registered.add,
        )
    except (RuntimeError, ValueError) as error:
        raise PrepareError(f"COLMAP's mapper failed: {_first_line(error)}") from error
    return list(models.values())


def _global(place: Workplace, settings: SfmSettings) -> list[Any]:
    from rtgs.core.colmap import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = options.mapper.random_seed = settings.seed
    options.num_threads = options.mapper.num_threads = settings.mapping.threads
    options.min_num_matches = settings.matching.min_inliers
    options.min_model_size = settings.mapping.min_model
    try:
        models = pycolmap.global_mapping(str(place.database), str(place.photos), str(place.models), options)
    except (RuntimeError, ValueError) as error:
        raise PrepareError(f"COLMAP's global mapper failed: {_first_line(error)}") from error
    return list(models.values())


def match_counts(names: Sequence[str], place: Workplace) -> np.ndarray:
    """(N, N) int64: verified matches between each two photos."""
    from rtgs.core.colmap import pycolmap

    counts = np.zeros((len(names), len(names)), dtype=np.int64)
    with pycolmap.Database.open(str(place.database)) as database:
        position = {_image_id(database, name): index for index, name in enumerate(names)}
        pair_ids, inliers = database.read_two_view_geometry_num_inliers()
        for pair, count in zip(pair_ids, inliers):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            i, j = position.get(first), position.get(second)
            if i is not None and j is not None:
                counts[i, j] = counts[j, i] = int(count)
    return counts


def _image_id(database: Any, name: str) -> int:
    return int(database.read_image_with_name(name).image_id)


def keypoint_counts(names: Sequence[str], place: Workplace) -> np.ndarray:
    """(N,) int64: keypoints of each photo."""
    from rtgs.core.colmap import pycolmap

    with pycolmap.Database.open(str(place.database)) as database:
        numbers = [_image_id(database, name) for name in names]
        return np.array([database.num_keypoints_for_image(number) for number in numbers], dtype=np.int64)


def turning_share(place: Workplace) -> float:
    """Share of the verified pairs that a turning camera without parallax explains (COLMAP's PANORAMIC)."""
    from rtgs.core.colmap import pycolmap

    turning = {
        pycolmap.TwoViewGeometryConfiguration.PANORAMIC,
        pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC,
    }
    with pycolmap.Database.open(str(place.database)) as database:
        geometries: Any = database.read_two_view_geometries()[1]
        kinds = [geometry.config for geometry in geometries]
    return sum(kind in turning for kind in kinds) / max(len(kinds), 1)


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
