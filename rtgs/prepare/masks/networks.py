"""Masks by GroundingDINO and SAM 2: their files, and a cache of the mask of each photo."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin

from rtgs.core.documents import parse_json
from rtgs.core.files import whole_file
from rtgs.core.recipe import canonical_json
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.detect import Box, Detector, PromptTokenizer
from rtgs.prepare.masks.maker import Made, PlainMaker, photo_of
from rtgs.prepare.masks.segment import Segmenter
from rtgs.prepare.masks.settings import MaskSettings
from rtgs.prepare.onnx import Network
from rtgs.prepare.pretrained import REGISTRY, check_noted_digest, find_weights
from rtgs.scenes.capture import CaptureView
from rtgs.scenes.digest import content_hash
from rtgs.scenes.images import read_mask

CACHE_VERSION = 1  # of single masks by networks
_NOTE = "rtgs boxes"


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


class NetworkMaker(PlainMaker):
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
        photo = photo_of(view)
        segments = self._segment(photo, self._detect(photo))
        inside = np.zeros(photo.shape[:2], dtype=bool)
        for segment in segments:
            inside |= segment.inside
        return inside, tuple(segment.box for segment in segments)


def _keep(inside: np.ndarray, boxes: tuple[Box, ...], path: Path) -> None:
    """A mask with its boxes, in one file that is there as a whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    words = PngImagePlugin.PngInfo()
    words.add_text(_NOTE, json.dumps([asdict(box) for box in boxes]))
    with whole_file(path) as partial:
        Image.fromarray(inside.astype(np.uint8) * 255).save(partial, "PNG", pnginfo=words)


def _kept_boxes(path: Path) -> tuple[Box, ...]:
    with Image.open(path) as picture:
        picture.load()
        return tuple(Box(**box) for box in parse_json(str(picture.info[_NOTE])))
