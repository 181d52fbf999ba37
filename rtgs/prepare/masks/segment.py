"""Masks from boxes: SAM 2 as a pair of ONNX files, in either of the two layouts its exports come in.

| | encoder | decoder |
|---|---|---|
| transformers' Sam2Model (onnx-community) | ``pixel_values`` -> ``image_embeddings.0 .1 .2`` | these, ``input_points``
(1, 1, P, 2), ``input_labels`` (1, 1, P), ``input_boxes`` (1, B, 4) -> ``iou_scores`` (1, B, 3), ``pred_masks``
(1, B, 3, h, w) |
| samexporter | ``image`` -> ``high_res_feats_0``, ``high_res_feats_1``, ``image_embed`` | these, ``point_coords``
(1, P, 2), ``point_labels`` (1, P; 2 and 3: corners of a box), ``mask_input``, ``has_mask_input`` -> ``masks``
(1, M, h, w), ``iou_predictions`` (1, M) |

Both stretch the photo to a square and want the prompt in its pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.detect import Box, imagenet_batch
from rtgs.prepare.masks.settings import SegmenterSettings
from rtgs.prepare.onnx import Network


@dataclass(frozen=True)
class _Layout:
    """Names of an export's ports."""

    name: str
    picture: str
    features: tuple[str, ...]
    prompts: tuple[str, ...]
    masks: str
    scores: str


LAYOUTS = (
    _Layout(
        "transformers",
        "pixel_values",
        ("image_embeddings.0", "image_embeddings.1", "image_embeddings.2"),
        ("input_points", "input_labels", "input_boxes"),
        "pred_masks",
        "iou_scores",
    ),
    _Layout(
        "samexporter",
        "image",
        ("high_res_feats_0", "high_res_feats_1", "image_embed"),
        ("point_coords", "point_labels", "mask_input", "has_mask_input"),
        "masks",
        "iou_predictions",
    ),
)


@dataclass(frozen=True)
class Segment:
    """The mask for one box."""

    inside: np.ndarray  # (H, W) bool
    score: float  # predicted IoU
    box: Box


class Segmenter:
    """SAM 2, one photo at a time."""

    def __init__(self, encoder: Network, decoder: Network, settings: SegmenterSettings) -> None:
        """Find the layout of the two files.

        Raises:
            PrepareError: they are of no known layout, or do not belong together.
        """
        self._encoder, self._decoder, self._settings = encoder, decoder, settings
        self._layout = _find_layout(encoder, decoder)
        known = {*self._layout.features, *self._layout.prompts, "orig_im_size"}
        unknown = [port.name for port in decoder.inputs if port.name not in known]
        if unknown:
            raise PrepareError(
                f"{decoder.path} also wants {', '.join(unknown)}: it is a decoder for videos, or another export; "
                "take one for single images (docs/networks.md)"
            )

    @property
    def layout(self) -> str:
        """``transformers`` or ``samexporter``."""
        return self._layout.name

    def __call__(self, photo: np.ndarray, boxes: list[Box]) -> list[Segment]:
        """The best mask for each box in a photo (H, W, 3) float32 in 0..1; those below ``min_score`` are left out.

        Raises:
            PrepareError: shapes that are not SAM 2's.
        """
        if not boxes:
            return []
        pixels = self._pixels(photo)
        features = self._encoder.run({self._layout.picture: pixels}, self._layout.features)
        shared = dict(zip(self._layout.features, features, strict=True))
        side = (pixels.shape[3], pixels.shape[2])
        segments = [self._segment(shared, box, photo.shape[:2], side) for box in boxes]
        return [segment for segment in segments if segment.score >= self._settings.min_score]

    def _pixels(self, photo: np.ndarray) -> np.ndarray:
        shape = self._encoder.input(self._layout.picture).shape
        rows, columns = (size or self._settings.size for size in (shape[2:] if len(shape) == 4 else (None, None)))
        return imagenet_batch(photo, rows, columns)

    def _segment(
        self, features: dict[str, np.ndarray], box: Box, size: tuple[int, ...], side: tuple[int, int]
    ) -> Segment:
        import cv2

        scale = np.array([side[0] / size[1], side[1] / size[0]])
        corners = np.array([[box.left, box.top], [box.right, box.bottom]]) * scale
        prompt = self._boxed(corners) if self._layout.name == "transformers" else self._pointed(corners, side, size)
        masks, scores = self._decoder.run({**features, **prompt}, (self._layout.masks, self._layout.scores))
        choices = masks.reshape(-1, *masks.shape[-2:]) if masks.ndim >= 3 else masks[None]
        ranks = scores.reshape(-1)
        if masks.ndim < 3 or len(choices) != len(ranks) or not len(ranks) or np.isnan(choices).any():
            raise PrepareError(
                f"{self._decoder.path} gives {self._layout.masks} {masks.shape} and {self._layout.scores} "
                f"{scores.shape} for one box, SAM 2's hold as many masks as scores: it is another model"
            )
        best = int(ranks.argmax())
        logits = cv2.resize(choices[best].astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
        return Segment(logits > self._settings.mask_threshold, float(ranks[best]), box)

    def _boxed(self, corners: np.ndarray) -> dict[str, np.ndarray]:
        """A box and no points (transformers' own way to fill the unused inputs)."""
        return {
            "input_points": np.zeros((1, 1, 0, 2), dtype=np.float32),
            "input_labels": np.zeros((1, 1, 0), dtype=np.int64),
            "input_boxes": corners.reshape(1, 1, 4).astype(np.float32),
        }

    def _pointed(self, corners: np.ndarray, side: tuple[int, int], size: tuple[int, ...]) -> dict[str, np.ndarray]:
        """A box as two points labelled 2 and 3 (the authors' predictor), and no earlier mask."""
        prompt = {
            "point_coords": corners[None].astype(np.float32),
            "point_labels": np.array([[2, 3]], dtype=np.float32),
            "mask_input": np.zeros((1, 1, side[1] // 4, side[0] // 4), dtype=np.float32),
            "has_mask_input": np.zeros(1, dtype=np.float32),
        }
        if any(port.name == "orig_im_size" for port in self._decoder.inputs):
            prompt["orig_im_size"] = np.array(size, dtype=np.float32)
        return prompt


def _find_layout(encoder: Network, decoder: Network) -> _Layout:
    inputs, outputs = {port.name for port in encoder.inputs}, {port.name for port in encoder.outputs}
    wanted, given = {port.name for port in decoder.inputs}, {port.name for port in decoder.outputs}
    for layout in LAYOUTS:
        reads = inputs == {layout.picture} and outputs >= set(layout.features)
        decodes = wanted >= {*layout.features, *layout.prompts} and given >= {layout.masks, layout.scores}
        if reads and decodes:
            return layout
        if reads:
            raise PrepareError(
                f"{decoder.path} ({', '.join(map(str, decoder.inputs))}) is no decoder for {encoder.path}, an encoder "
                f"in the layout of {layout.name}: take both files from one export"
            )
    ports = f"{', '.join(map(str, encoder.inputs))} -> {', '.join(map(str, encoder.outputs))}"
    raise PrepareError(
        f"{encoder.path} ({ports}) is no encoder of SAM 2 in the layout of transformers (pixel_values -> "
        "image_embeddings.0 .1 .2) or samexporter (image -> high_res_feats_0, high_res_feats_1, image_embed): SAM 1 "
        "and other exports differ; docs/networks.md says how to make it"
    )
