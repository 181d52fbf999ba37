"""Checkpoints of GroundingDINO and SAM 2 on this machine become the ONNX files that masks are made with.

    python -m rtgs.prepare.masks.onnx_export <folder of a checkpoint> <folder of weights>

The folder holds ``config.json`` and the weights as transformers saves them (of ``IDEA-Research/grounding-dino-tiny``,
``facebook/sam2.1-hiera-tiny`` ...). Needs ``pip install transformers onnx``; nothing is downloaded.
"""

from __future__ import annotations

import argparse
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.detect import INPUTS, OPTIONAL_INPUTS, OUTPUTS
from rtgs.prepare.masks.segment import LAYOUTS
from rtgs.prepare.pretrained import REGISTRY

OPSET = 17
_SIDE = 800  # pixels of GroundingDINO's input; its short side in the authors' preprocessing
_TEXT = (*INPUTS[1:], *OPTIONAL_INPUTS[1:])


class _Detection(nn.Module):
    """GroundingDINO with the inputs and outputs of its usual exports."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(
        self,
        pixel_values: Tensor,
        input_ids: Tensor,
        pixel_mask: Tensor,
        token_type_ids: Tensor,
        attention_mask: Tensor,
    ) -> tuple[Tensor, Tensor]:
        found = self.model(pixel_values, input_ids, token_type_ids, attention_mask, pixel_mask)
        return found.logits, found.pred_boxes


class _Encoding(nn.Module):
    """SAM 2's picture features."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixel_values: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.model.get_image_embeddings(pixel_values))


class _Decoding(nn.Module):
    """SAM 2's masks for prompts."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, fine: Tensor, middle: Tensor, coarse: Tensor, points: Tensor, labels: Tensor, boxes: Tensor
    ) -> tuple[Tensor, Tensor]:
        prompts = {"input_points": points, "input_labels": labels, "input_boxes": boxes}
        found = self.model(image_embeddings=[fine, middle, coarse], **prompts)
        return found.iou_scores, found.pred_masks


def phrase_masks(input_ids: Tensor, special_tokens: Tensor) -> tuple[Tensor, Tensor]:
    """Which tokens see each other (B, T, T) bool, and the place of each in its phrase (B, T).

    What transformers' ``generate_masks_with_special_tokens_and_transfer_map`` computes, in operations of ONNX, for
    any number of phrases: a token sees those of its phrase, up to the full stop; the first and the last token, and what
    no full stop ends, see only themselves.
    """
    count = input_ids.shape[1]
    index = torch.arange(count, device=input_ids.device)
    special = (input_ids[..., None] == special_tokens).any(-1)  # (B, T)
    ends = special[:, None, :] & (index[None, :] >= index[:, None])  # [b, i, j]: j ends what i belongs to
    after = torch.where(ends, index, count).amin(-1)  # (B, T)
    starts = special[:, None, :] & (index[None, :] < index[:, None])
    before = torch.where(starts, index, -1).amax(-1)
    phrase = (after != 0) & (after < count - 1)
    together = (after[:, :, None] == after[:, None, :]) & phrase[:, None, :]
    alone = index[None, :] == index[:, None]
    place = torch.where(phrase, index - before - 1, 0).clamp(min=0)
    return together | alone, place


@contextmanager
def _exportable() -> Iterator[None]:
    """Transformers' text masks as :func:`phrase_masks`, and the exporter without its warnings."""
    from transformers.models.grounding_dino import modeling_grounding_dino as module

    name = "generate_masks_with_special_tokens_and_transfer_map"
    kept = getattr(module, name)
    setattr(module, name, phrase_masks)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            yield
    finally:
        setattr(module, name, kept)


def export_grounding_dino(model: nn.Module, path: Path, side: int = _SIDE) -> None:
    """Write a ``GroundingDinoForObjectDetection``, for pictures of ``side`` x ``side`` and prompts of any length."""
    words = torch.tensor([[101, 5, 6, 1012, 7, 1012, 102]])  # two phrases: nothing is fixed to one
    pixels = torch.linspace(-1, 1, 3 * side * side).reshape(1, 3, side, side)
    texts = (torch.zeros_like(words), torch.ones_like(words))
    names = [*INPUTS, *OPTIONAL_INPUTS]
    values = (pixels, words, torch.ones(1, side, side, dtype=torch.int64), *texts)
    with _exportable():
        _export(_Detection(model.eval()), values, path, names, list(OUTPUTS), {name: {1: "tokens"} for name in _TEXT})


def export_sam2(model: Any, encoder: Path, decoder: Path) -> None:
    """Write a ``Sam2Model`` as encoder and decoder, for any number of points and of boxes."""
    layout = LAYOUTS[0]
    side = int(model.config.prompt_encoder_config.image_size)
    pixels = torch.linspace(-1, 1, 3 * side * side).reshape(1, 3, side, side)
    model.eval()
    with _exportable():
        features = _Encoding(model)(pixels)
        _export(_Encoding(model), (pixels,), encoder, [layout.picture], list(layout.features), {})
        points, labels = torch.full((1, 1, 2, 2), side / 2), torch.ones(1, 1, 2, dtype=torch.int64)
        values = (*features, points, labels, torch.tensor([[[0.2, 0.2, 0.7, 0.7]]]) * side)
        free = {"input_points": {2: "points"}, "input_labels": {2: "points"}, "input_boxes": {1: "boxes"}}
        free |= {layout.scores: {1: "boxes"}, layout.masks: {1: "boxes"}}
        names = [*layout.features, *layout.prompts]
        _export(_Decoding(model), values, decoder, names, [layout.scores, layout.masks], free)


def _export(
    module: nn.Module,
    values: tuple[Tensor, ...],
    path: Path,
    inputs: list[str],
    outputs: list[str],
    free: dict[str, dict[int, str]],
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        module,
        values,
        str(path),
        input_names=inputs,
        output_names=outputs,
        dynamic_axes=free,
        opset_version=OPSET,
        dynamo=False,
    )
    _in_single_precision(path)


def _in_single_precision(path: Path) -> None:
    """The exporter makes some constants double, for which onnxruntime has no GridSample: all become float."""
    import onnx

    model = onnx.load(str(path))
    _demote(model.graph)
    onnx.save(model, str(path))


def _demote(graph: Any) -> None:
    from onnx import TensorProto, numpy_helper

    def demoted(tensor: Any) -> None:
        if tensor.data_type == TensorProto.DOUBLE:
            tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float32), tensor.name))

    for tensor in graph.initializer:
        demoted(tensor)
    del graph.value_info[:]
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.name == "to" and attribute.i == TensorProto.DOUBLE:
                attribute.i = TensorProto.FLOAT
            if attribute.HasField("t"):
                demoted(attribute.t)
            if attribute.HasField("g"):
                _demote(attribute.g)


def export(checkpoint: Path, weights: Path, side: int = _SIDE) -> list[Path]:
    """Export the model in a folder under its registered names; returns what was written. ``side``: of GroundingDINO.

    Raises:
        PrepareError: no transformers, or no checkpoint of the two.
    """
    try:
        from transformers import AutoConfig, GroundingDinoForObjectDetection, Sam2Model
    except ImportError as error:
        raise PrepareError("the export needs the package transformers: pip install transformers onnx") from error
    if not (checkpoint / "config.json").is_file():
        raise PrepareError(
            f"{checkpoint} holds no config.json: name the folder of a checkpoint that is on this machine"
        )
    kind = AutoConfig.from_pretrained(checkpoint, local_files_only=True).model_type
    places = {name: weights / file.filename for name, file in REGISTRY.items()}
    if kind == "grounding-dino":
        model = GroundingDinoForObjectDetection.from_pretrained(checkpoint, local_files_only=True)
        export_grounding_dino(model, places["grounding_dino"], side)
        shutil.copyfile(checkpoint / "tokenizer.json", places["grounding_dino_tokenizer"])
        return [places["grounding_dino"], places["grounding_dino_tokenizer"]]
    if kind in ("sam2", "sam2_video"):
        model = Sam2Model.from_pretrained(checkpoint, local_files_only=True)
        export_sam2(model, places["sam2_encoder"], places["sam2_decoder"])
        return [places["sam2_encoder"], places["sam2_decoder"]]
    raise PrepareError(f"{checkpoint} is a {kind}: only GroundingDINO and SAM 2 make masks")


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m rtgs.prepare.masks.onnx_export", description=__doc__)
    parser.add_argument(
        "checkpoint", type=Path, help="folder with config.json and the weights, as transformers saves them"
    )
    parser.add_argument("weights", type=Path, help="folder of weights (`rtgs weights status` lists those searched)")
    parser.add_argument(
        "--side", type=int, default=_SIDE, help="pixels of GroundingDINO's input (default: %(default)s)"
    )
    options = parser.parse_args()
    for written in export(options.checkpoint, options.weights, options.side):
        print(written)
