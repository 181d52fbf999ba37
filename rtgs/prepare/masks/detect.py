"""Boxes from words: GroundingDINO as an ONNX file, in the layout of transformers' GroundingDinoForObjectDetection.

Inputs ``pixel_values`` (1, 3, H, W), ``pixel_mask`` (1, H, W), ``input_ids``, ``token_type_ids``, ``attention_mask``
(1, T); outputs ``logits`` (1, Q, T or 256) before the sigmoid, ``pred_boxes`` (1, Q, 4) centre and size in 0..1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.settings import DetectorSettings
from rtgs.prepare.normals.adapters import IMAGENET_MEAN, IMAGENET_STD
from rtgs.prepare.onnx import Network

INPUTS = ("pixel_values", "input_ids")
OPTIONAL_INPUTS = ("pixel_mask", "token_type_ids", "attention_mask")
OUTPUTS = ("logits", "pred_boxes")
_MAX_TOKENS = 256  # the model's max_text_len


@dataclass(frozen=True)
class Box:
    """Something found: corners in pixels of the photo, x right, y down."""

    left: float
    top: float
    right: float
    bottom: float
    score: float  # 0..1
    phrase: str

    @property
    def area(self) -> float:
        """Square pixels."""
        return max(self.right - self.left, 0.0) * max(self.bottom - self.top, 0.0)


@dataclass(frozen=True)
class Tokens:
    """A prompt as the text encoder takes it."""

    ids: np.ndarray  # (T,) int64
    types: np.ndarray
    attention: np.ndarray
    phrases: tuple[str, ...]
    spans: tuple[tuple[int, int], ...]  # tokens of each phrase, half open


class PromptTokenizer:
    """The WordPiece tokenizer of the text encoder, from a local ``tokenizer.json``."""

    def __init__(self, path: Path) -> None:
        """Load ``path``.

        Raises:
            PrepareError: no package tokenizers, or no tokenizer file of a BERT-like model.
        """
        try:
            from tokenizers import Tokenizer
        except ImportError as error:
            raise PrepareError(
                f"{path.name} needs the package tokenizers: pip install -e '.[prepare]' in the clone of rtgs, or "
                "mark the glass by hand (masks=grabcut, masks=polygon)"
            ) from error
        try:
            self._tokenizer: Any = Tokenizer.from_file(str(path))
        except Exception as error:  # the package raises plain Exception
            raise PrepareError(
                f"{path} is no tokenizer file ({str(error)[:160]}): take tokenizer.json from where the model came from"
            ) from error
        self.path = path
        self._tokenizer.no_padding()
        self._tokenizer.no_truncation()
        ends = [self._tokenizer.token_to_id(token) for token in ("[CLS]", "[SEP]", ".")]
        if None in ends:
            raise PrepareError(
                f"{path} knows no [CLS], [SEP] or '.': GroundingDINO reads text with BERT's vocabulary "
                "(bert-base-uncased); take tokenizer.json from where the model came from"
            )
        self._ends = frozenset(ends)

    def encode(self, phrases: tuple[str, ...]) -> Tokens:
        """The tokens of ``a . b .``; phrases in lower case.

        Raises:
            PrepareError: too long for the network, or a phrase of which nothing is left.
        """
        encoded = self._tokenizer.encode(" . ".join(phrases) + " .")
        ids = np.asarray(encoded.ids, dtype=np.int64)
        if len(ids) > _MAX_TOKENS:
            raise PrepareError(
                f"masks.detector.prompt is {len(ids)} tokens long, GroundingDINO reads {_MAX_TOKENS}: name fewer "
                "things, or set masks.detector.phrases=separate"
            )
        spans, start = [], 0
        for index, token in enumerate(ids):
            if int(token) in self._ends:
                if index > start:
                    spans.append((start, index))
                start = index + 1
        if len(spans) != len(phrases):
            raise PrepareError(
                f"masks.detector.prompt: the tokenizer makes {len(spans)} phrases of {list(phrases)}; use plain words"
            )
        types, attention = (np.asarray(values, dtype=np.int64) for values in (encoded.type_ids, encoded.attention_mask))
        return Tokens(ids, types, attention, phrases, tuple(spans))


def split_prompt(prompt: str) -> tuple[str, ...]:
    """The phrases of ``glass . bottle``, in lower case."""
    return tuple(" ".join(part.lower().split()) for part in prompt.split(".") if part.strip())


def imagenet_batch(photo: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """(1, 3, rows, columns) float32: a photo (H, W, 3) in 0..1, stretched, by ImageNet's mean and deviation."""
    import cv2

    mode = cv2.INTER_AREA if rows * columns < photo.shape[0] * photo.shape[1] else cv2.INTER_LINEAR
    scaled = cv2.resize(photo, (columns, rows), interpolation=mode)
    normalised = (scaled - np.array(IMAGENET_MEAN)) / np.array(IMAGENET_STD)
    return np.ascontiguousarray(normalised.transpose(2, 0, 1)[None], dtype=np.float32)


class Detector:
    """GroundingDINO with its tokenizer."""

    def __init__(self, network: Network, tokenizer: PromptTokenizer, settings: DetectorSettings) -> None:
        """Check the network's ports and encode the prompt.

        Raises:
            PrepareError: another model, or a prompt it cannot read.
        """
        network.require(INPUTS, OUTPUTS)
        unknown = [port.name for port in network.inputs if port.name not in (*INPUTS, *OPTIONAL_INPUTS)]
        if unknown:
            raise PrepareError(
                f"{network.path} also wants {', '.join(unknown)}: exports of the original repository take other text "
                "inputs; take that of transformers' GroundingDinoForObjectDetection (docs/networks.md)"
            )
        self._network, self._settings = network, settings
        phrases = split_prompt(settings.prompt)
        groups = [phrases] if settings.phrases == "together" else [(phrase,) for phrase in phrases]
        self._prompts = tuple(self._fitted(tokenizer.encode(group)) for group in groups)

    def _fitted(self, tokens: Tokens) -> Tokens:
        """Tokens filled up with padding where the export has a fixed length."""
        shape = self._network.input("input_ids").shape
        length = shape[1] if len(shape) == 2 else None
        if length is None or length == len(tokens.ids):
            return tokens
        if length < len(tokens.ids):
            raise PrepareError(
                f"{self._network.path} reads {length} tokens, the prompt has {len(tokens.ids)}: name fewer things, or "
                "export it with a free length"
            )
        fill = (0, length - len(tokens.ids))
        ids, types, attention = (np.pad(part, fill) for part in (tokens.ids, tokens.types, tokens.attention))
        return Tokens(ids, types, attention, tokens.phrases, tokens.spans)

    def __call__(self, photo: np.ndarray) -> list[Box]:
        """Boxes in a photo (H, W, 3) float32 in 0..1, best first.

        Raises:
            PrepareError: the network's outputs are not those of GroundingDINO.
        """
        pixels = self._pixels(photo)
        found: list[Box] = []
        for tokens in self._prompts:
            values = {
                "pixel_values": pixels,
                "pixel_mask": np.ones((1, *pixels.shape[2:]), dtype=np.int64),
                "input_ids": tokens.ids[None],
                "token_type_ids": tokens.types[None],
                "attention_mask": tokens.attention[None],
            }
            logits, boxes = self._network.run(values, OUTPUTS)
            self._check(logits, boxes, tokens)
            found += read_boxes(logits[0], boxes[0], tokens, self._settings, (photo.shape[1], photo.shape[0]))
        large = self._settings.max_area * photo.shape[0] * photo.shape[1]
        kept = suppress([box for box in found if box.area <= large], self._settings.nms_iou)
        return kept[: self._settings.max_boxes]

    def _pixels(self, photo: np.ndarray) -> np.ndarray:
        shape = self._network.input("pixel_values").shape
        height, width = photo.shape[:2]
        scale = min(self._settings.short_side / min(height, width), self._settings.long_side / max(height, width))
        rows = shape[2] if len(shape) == 4 and shape[2] else max(32, round(height * scale))
        columns = shape[3] if len(shape) == 4 and shape[3] else max(32, round(width * scale))
        return imagenet_batch(photo, rows, columns)

    def _check(self, logits: np.ndarray, boxes: np.ndarray, tokens: Tokens) -> None:
        fits = (
            logits.ndim == 3
            and boxes.ndim == 3
            and boxes.shape[2] == 4
            and logits.shape[:2] == boxes.shape[:2] == (1, boxes.shape[1])
            and logits.shape[2] >= tokens.spans[-1][1]
        )
        if not fits:
            raise PrepareError(
                f"{self._network.path} gives logits {logits.shape} and pred_boxes {boxes.shape} for {len(tokens.ids)} "
                "tokens, GroundingDINO's are (1, Q, 256) and (1, Q, 4): it is another model"
            )
        if np.isnan(logits).any() or not np.isfinite(boxes).all():
            raise PrepareError(f"{self._network.path} gives NaN: take another precision of the export (model.onnx)")


def read_boxes(
    logits: np.ndarray, boxes: np.ndarray, tokens: Tokens, settings: DetectorSettings, size: tuple[int, int]
) -> list[Box]:
    """Boxes above the thresholds from ``logits`` (Q, T) and ``boxes`` (Q, 4), in pixels of (width, height)."""
    with np.errstate(over="ignore"):
        scores = 1 / (1 + np.exp(-logits.astype(np.float64)))  # -inf, the padding, gives 0
    by_phrase = np.stack([scores[:, start:stop].max(axis=1) for start, stop in tokens.spans], axis=1)  # (Q, phrases)
    named, best = by_phrase.argmax(axis=1), by_phrase.max(axis=1)
    keep = (best > settings.box_threshold) & (best > settings.text_threshold)
    middle, extent = boxes[:, :2] * size, boxes[:, 2:] * size
    low = np.clip(middle - extent / 2, 0, size)
    high = np.clip(middle + extent / 2, 0, size)
    found = []
    for index in np.flatnonzero(keep & ((high - low).min(axis=1) >= 1)):
        (left, top), (right, bottom) = low[index].tolist(), high[index].tolist()
        found.append(Box(left, top, right, bottom, float(best[index]), tokens.phrases[named[index]]))
    return found


def suppress(boxes: list[Box], limit: float) -> list[Box]:
    """Non-maximum suppression over all phrases; best first."""
    kept: list[Box] = []
    for box in sorted(boxes, key=lambda box: -box.score):
        if all(box_iou(box, other) <= limit for other in kept):
            kept.append(box)
    return kept


def box_iou(a: Box, b: Box) -> float:
    """Area of the intersection over that of the union."""
    width = min(a.right, b.right) - max(a.left, b.left)
    height = min(a.bottom, b.bottom) - max(a.top, b.top)
    common = max(width, 0.0) * max(height, 0.0)
    whole = a.area + b.area - common
    return common / whole if whole > 0 else 0.0
