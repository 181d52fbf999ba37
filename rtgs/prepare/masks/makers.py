"""The ways to a mask of one photo: given, by networks, from marks of a person."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from PIL import Image, PngImagePlugin

from rtgs.core.recipe import canonical_json
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.detect import Box, Detector, PromptTokenizer
from rtgs.prepare.masks.drawn import Cutout, read_drawing
from rtgs.prepare.masks.given import given_files, read_given
from rtgs.prepare.masks.grabcut import Marks, grab_cut
from rtgs.prepare.masks.hull import Hull, SmallMask, carve, small_mask
from rtgs.prepare.masks.plane import Pane, fit_pane, in_polygon, seen_from
from rtgs.prepare.masks.report import DrawnPane
from rtgs.prepare.masks.segment import Segmenter
from rtgs.prepare.masks.settings import MaskSettings
from rtgs.prepare.onnx import Network
from rtgs.prepare.poses.export import read_lenses
from rtgs.prepare.pretrained import REGISTRY, check_noted_digest, find_weights
from rtgs.scenes.capture import Capture, CaptureView, list_some
from rtgs.scenes.digest import content_hash
from rtgs.scenes.images import image_size, nearest_resize, read_mask, read_photo, same_aspect
from rtgs.scenes.undistort import project, unproject

CACHE_VERSION = 1  # of single masks by networks
_PLANE_SIDE = 1600  # pixels, long side of the masks of panes; the import brings them to the size of the views
_CARRY_VIEWS = 3  # marked photos whose hull says where the object is in the others
_NOTE = "rtgs boxes"


@dataclass(frozen=True)
class Made:
    """What came out for one photo."""

    inside: np.ndarray | None  # (H, W) bool, upright, of the photo's aspect; None: no mask
    origin: str
    boxes: tuple[Box, ...] = ()
    from_cache: bool = False
    note: str = ""


class Maker(Protocol):
    """One way to masks."""

    solid: bool
    """What is masked has a volume that a visual hull can be carved of."""
    networks: tuple[str, ...]
    notes: tuple[str, ...]
    panes: tuple[DrawnPane, ...]
    """Flat glass that was drawn."""

    def order(self, views: Sequence[CaptureView]) -> list[CaptureView]:
        """The photos in the order they are to be done."""
        ...

    def __call__(self, view: CaptureView) -> Made:
        """The mask of a photo."""
        ...

    def learn(self, mask: SmallMask) -> None:
        """A mask that was made, small."""
        ...


def make_maker(
    method: str,
    settings: MaskSettings,
    capture: Capture,
    views: Sequence[CaptureView],
    source: Path,
    cache: Path,
    threads: int,
) -> Maker:
    """The way of this name.

    Raises:
        PrepareError, MissingWeights: see the ways.
    """
    if method == "given":
        return GivenMaker(settings, views, source)
    if method == "grounded_sam2":
        return NetworkMaker(settings, cache, threads)
    return DrawnMaker(method, settings, capture, views, source)


class _PlainMaker:
    """What most ways share."""

    solid: bool = True
    networks: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    panes: tuple[DrawnPane, ...] = ()

    def order(self, views: Sequence[CaptureView]) -> list[CaptureView]:
        """As they are."""
        return list(views)

    def learn(self, mask: SmallMask) -> None:
        """Nothing to learn."""


class GivenMaker(_PlainMaker):
    """Masks that are there."""

    def __init__(self, settings: MaskSettings, views: Sequence[CaptureView], source: Path) -> None:
        """Find the files.

        Raises:
            PrepareError: none.
        """
        self._given = settings.given
        self._files = given_files(views, source / (settings.given.folder or "masks"), settings.given)
        without = [view.name for view in views if view.name not in self._files]
        if without:
            self.notes = (f"{len(without)} photos have no mask: {list_some(without, 6)}",)

    def __call__(self, view: CaptureView) -> Made:
        """Read it.

        Raises:
            PrepareError: it does not fit the photo.
            CaptureError: it cannot be read.
        """
        path = self._files.get(view.name)
        return Made(None, "") if path is None else Made(read_given(path, view, self._given), "given")


@dataclass(frozen=True)
class NetworkFiles:
    """The files of GroundingDINO and SAM 2 in force, and the digest of each."""

    detector: Path
    tokenizer: Path
    encoder: Path
    decoder: Path

    @property
    def digests(self) -> tuple[tuple[str, str], ...]:
        """Name and SHA-256, weights in files of their own (``.onnx_data``) included."""
        return tuple(
            (name, file_digest(getattr(self, name))) for name in ("detector", "tokenizer", "encoder", "decoder")
        )


def find_networks(settings: MaskSettings) -> NetworkFiles:
    """The files in force.

    Raises:
        MissingWeights, PrepareError: one is not there; says where to get it, or which setting names it.
    """
    detector, segmenter = settings.detector, settings.segmenter
    found = _find("masks.detector.file", detector.file, "grounding_dino")
    beside = str(found.parent / "tokenizer.json") if detector.file and not detector.tokenizer else detector.tokenizer
    return NetworkFiles(
        found,
        _find("masks.detector.tokenizer", beside, "grounding_dino_tokenizer"),
        _find("masks.segmenter.encoder", segmenter.encoder, "sam2_encoder"),
        _find("masks.segmenter.decoder", segmenter.decoder, "sam2_decoder"),
    )


def _find(key: str, named: str, registered: str) -> Path:
    if not named:
        return find_weights(REGISTRY[registered])
    path = Path(named).expanduser()
    if not path.is_file():
        raise PrepareError(f"{key}={named} does not exist: correct it, or see `rtgs weights status`")
    return path


def file_digest(path: Path) -> str:
    """SHA-256 of a network's file and of the weights in files of their own beside it.

    Raises:
        WrongWeights: one that ``SHA256SUMS`` states is another.
    """
    files = [path]
    if path.suffix == ".onnx":
        files += sorted(other for other in path.parent.iterdir() if other.name.endswith((".onnx_data", ".onnx.data")))
    digests = []
    for file in files:
        state = file.stat()
        digests.append(content_hash(str(file), state.st_size, state.st_mtime_ns))
        check_noted_digest(file, digests[-1])
    return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()


class NetworkMaker(_PlainMaker):
    """GroundingDINO finds boxes for words, SAM 2 makes masks of them; each photo once, whatever else changes."""

    def __init__(self, settings: MaskSettings, cache: Path, threads: int) -> None:
        """Load the networks.

        Raises:
            MissingWeights: a file is not there.
            PrepareError: a file that is no such network.
        """
        files = find_networks(settings)
        self._settings, self._cache = settings, cache
        self._recipe = {
            "version": CACHE_VERSION,
            "networks": files.digests,
            "detector": {**asdict(settings.detector), "file": "", "tokenizer": ""},
            "segmenter": {**asdict(settings.segmenter), "encoder": "", "decoder": ""},
        }
        self.networks = tuple(f"{getattr(files, name).name} {digest}" for name, digest in files.digests)
        tokenizer = PromptTokenizer(files.tokenizer)
        self._detect = Detector(Network(files.detector, threads), tokenizer, settings.detector)
        self._segment = Segmenter(Network(files.encoder, threads), Network(files.decoder, threads), settings.segmenter)

    def __call__(self, view: CaptureView) -> Made:
        """From the cache, or made and kept there.

        Raises:
            PrepareError: outputs that are not those of the networks.
            CaptureError: an unreadable photo.
        """
        kept = self._cache / f"{self._key(view)}.png"
        cached = kept.is_file()
        if not cached:
            inside, boxes = self._make(view)
            _keep(inside, boxes, kept)
        inside, boxes = read_mask(kept), _kept_boxes(kept)
        return Made(inside, "networks" if boxes else "nothing found", boxes, cached)

    def _key(self, view: CaptureView) -> str:
        assert view.lens is not None
        state = view.image.stat()
        photo = content_hash(str(view.image), state.st_size, state.st_mtime_ns)
        recipe = {**self._recipe, "photo": photo, "size": [view.lens.width, view.lens.height]}
        return hashlib.sha256(canonical_json(recipe).encode()).hexdigest()

    def _make(self, view: CaptureView) -> tuple[np.ndarray, tuple[Box, ...]]:
        photo = _photo(view)
        segments = self._segment(photo, self._detect(photo))
        inside = np.zeros(photo.shape[:2], dtype=bool)
        for segment in segments:
            inside |= segment.inside
        return inside, tuple(segment.box for segment in segments)


def _photo(view: CaptureView) -> np.ndarray:
    assert view.lens is not None, "photos without a lens are refused when the capture is read"
    return read_photo(view.image, expected=(view.lens.width, view.lens.height))


def _keep(inside: np.ndarray, boxes: tuple[Box, ...], path: Path) -> None:
    """A mask with its boxes, in one file that is there as a whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    words = PngImagePlugin.PngInfo()
    words.add_text(_NOTE, json.dumps([asdict(box) for box in boxes]))
    partial = path.with_name(f"{path.name}.part")
    Image.fromarray(inside.astype(np.uint8) * 255).save(partial, "PNG", pnginfo=words)
    partial.replace(path)


def _kept_boxes(path: Path) -> tuple[Box, ...]:
    with Image.open(path) as picture:
        picture.load()
        return tuple(Box(**box) for box in json.loads(str(picture.info[_NOTE])))


class DrawnMaker(_PlainMaker):
    """Flat panes carried by the poses, outlines and GrabCut; from what a person marked in a few photos."""

    def __init__(
        self, method: str, settings: MaskSettings, capture: Capture, views: Sequence[CaptureView], source: Path
    ) -> None:
        """Read the file of marks and fit its panes.

        Raises:
            PrepareError: the file is not there or not of its form, it lacks what ``method`` wants, or a pane fits no
                plane.
        """
        self._settings, self._clean = settings.drawn, settings.clean
        by_name = {view.name: view for view in views}
        self._lenses = read_lenses(capture.root)
        self._drawing = read_drawing(source / settings.drawn.file, by_name)
        self._cutouts = self._drawing.cutouts if method in ("grabcut", "drawn") else {}
        panes = self._drawing.panes if method in ("polygon", "drawn") else {}
        if not (panes or self._cutouts):
            wanted, other = ("panes", "grabcut") if method == "polygon" else ("cutouts", "polygon")
            raise PrepareError(f"{self._drawing.path} has no {wanted}, which masks={method} needs: set masks={other}")
        self._panes = [
            fit_pane(
                name,
                {photo: self._shares(marks, by_name[photo]) for photo, marks in corners.items()},
                by_name,
                capture.points,
                self._settings,
            )
            for name, corners in panes.items()
        ]
        self.solid = not self._panes
        self.panes = tuple(
            DrawnPane(pane.name, tuple((float(x), float(y), float(z)) for x, y, z in pane.corners))
            for pane in self._panes
        )
        self.notes = tuple(_words(pane, self._settings.max_error) for pane in self._panes)
        self._marked: list[SmallMask] = []
        self._hull: Hull | None = None
        self._carved = False

    def order(self, views: Sequence[CaptureView]) -> list[CaptureView]:
        """Marked photos first: the others learn from them."""
        return sorted(views, key=lambda view: view.name not in self._cutouts)

    def learn(self, mask: SmallMask) -> None:
        """Keep the masks of marked photos."""
        if mask.name in self._cutouts:
            self._marked.append(mask)

    def __call__(self, view: CaptureView) -> Made:
        """The union of its panes and of the cut.

        Raises:
            CaptureError: an unreadable photo.
        """
        inside, origin = self._pane_mask(view)
        cut, how = self._cut(view)
        if cut is None:
            return Made(inside, origin)
        if inside is None:
            return Made(cut, how)
        return Made(nearest_resize(inside, cut.shape[1], cut.shape[0]) | cut, f"{origin}; {how}")

    def _shares(self, points: np.ndarray, view: CaptureView) -> np.ndarray:
        """Marks (N, 2) as shares of the capture's photo, whose lens may be another than that of the photo marked."""
        original = self._lenses.get(view.name)
        if original is None:
            return self._drawing.shares(points, upright_size(view))
        assert view.lens is not None
        size = (original.width, original.height)
        rays = unproject(original, self._drawing.shares(points, size) * size)
        return project(view.lens, rays) / (view.lens.width, view.lens.height)

    def _marks(self, cutout: Cutout, view: CaptureView) -> Marks:
        box = self._shares(np.reshape(cutout.box, (-1, 2)), view).ravel()
        return Marks(tuple(box.tolist()), self._shares(cutout.inside, view), self._shares(cutout.outside, view))

    def _pane_mask(self, view: CaptureView) -> tuple[np.ndarray | None, str]:
        if not self._panes:
            return None, ""
        assert view.lens is not None
        scale = min(1.0, _PLANE_SIDE / max(view.lens.width, view.lens.height))
        lens = view.lens.resized(round(view.lens.width * scale), round(view.lens.height * scale))
        inside = np.any([seen_from(pane, view, lens) for pane in self._panes], axis=0)
        drawn = [pane.name for pane in self._panes if view.name in pane.error]
        return inside, f"pane drawn here ({', '.join(drawn)})" if drawn else "pane carried by the poses"

    def _cut(self, view: CaptureView) -> tuple[np.ndarray | None, str]:
        cutout = self._cutouts.get(view.name)
        if cutout is not None and len(cutout.outline):
            return _filled(self._shares(cutout.outline, view), view), "outlined by a person"
        if cutout is not None:
            return grab_cut(_photo(view), self._marks(cutout, view), self._settings), "GrabCut from marks"
        hull = self._hull_of_marks()
        if hull is None:
            return None, ""
        width, height = upright_size(view)
        rough = hull.silhouette(small_mask(view, np.zeros((height, width), dtype=bool), self._clean.mask_size))
        if all(len(marks.outline) for marks in self._cutouts.values()):
            return nearest_resize(rough, width, height), "hull of the outlines"
        return grab_cut(_photo(view), Marks(rough=rough), self._settings), "GrabCut from the hull of the marked photos"

    def _hull_of_marks(self) -> Hull | None:
        """Carved when the first photo without marks comes; None where too few are marked, or it is not wanted."""
        if not self._settings.carry or len(self._marked) < _CARRY_VIEWS:
            return None
        if not self._carved:
            self._hull, self._carved = carve(self._marked, self._clean, 0.0), True
        return self._hull


def _filled(shares: np.ndarray, view: CaptureView) -> np.ndarray:
    """(H, W) bool: the polygon (K, 2) in shares of the photo, at its size."""
    width, height = upright_size(view)
    across = (np.arange(width) + 0.5) / width
    rows = [
        in_polygon(np.column_stack([across, np.full(width, (row + 0.5) / height)]), shares) for row in range(height)
    ]
    return np.array(rows)


def upright_size(view: CaptureView) -> tuple[int, int]:
    """Width and height of a photo's file as :func:`rtgs.scenes.images.read_photo` turns it."""
    assert view.lens is not None
    size = image_size(view.image)
    return size if same_aspect(size, (view.lens.width, view.lens.height)) else (size[1], size[0])


def _words(pane: Pane, limit: float) -> str:
    text = f"pane {pane.name}: {pane.origin}"
    if pane.angle:
        text += (
            f"; drawn and carried corners {100 * float(np.mean(list(pane.error.values()))):.2f} % of the photo apart"
        )
    wide = [f"{photo} {error:.1%}" for photo, error in pane.error.items() if error > limit]
    return f"{text}; look at {', '.join(wide)}" if wide else text
