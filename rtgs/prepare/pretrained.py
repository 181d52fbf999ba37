"""Every pretrained file rtgs can use: those of the metrics and those of the preparation. Nothing is ever downloaded.

The preparation's networks run through onnxruntime. Their files are exported by people (or taken from an export somebody
published), so no digest is registered; a recipe states the digest of the file it used, and digests noted in a
``SHA256SUMS`` of the folder of weights are checked. Sizes are of common exports.
"""

from __future__ import annotations

from rtgs.pretrained.weights import REGISTRY as METRICS
from rtgs.pretrained.weights import (
    MissingWeights,
    PretrainedFile,
    WeightStatus,
    WrongWeights,
    check_noted_digest,
    find_weights,
    verify_weights,
    weight_folders,
    weights_report,
)

__all__ = [
    "REGISTRY",
    "MissingWeights",
    "PretrainedFile",
    "WeightStatus",
    "WrongWeights",
    "check_noted_digest",
    "find_weights",
    "verify_weights",
    "weight_folders",
    "weights_report",
]

_ANY_EXPORT = "torch.onnx.export of the authors' model with input (1, 3, H, W), names as in docs/networks.md"
_SAM2_EXPORT = (
    "take onnx/{part}.onnx and its .onnx_data (which keeps its name) of the published export "
    "onnx-community/sam2.1-hiera-tiny-ONNX, or python -m samexporter.export_sam2 (github.com/vietanhdev/samexporter)"
)

PREPARATION: tuple[PretrainedFile, ...] = (
    PretrainedFile(
        name="grounding_dino",
        filename="grounding_dino/model.onnx",
        sha256="",
        megabytes=690,
        licence="Apache-2.0",
        source="huggingface.co/IDEA-Research/grounding-dino-tiny",
        used_for="masks: boxes from words",
        export="take onnx/model.onnx of the published export onnx-community/grounding-dino-tiny-ONNX, or "
        "python -m rtgs.prepare.masks.onnx_export",
    ),
    PretrainedFile(
        name="grounding_dino_tokenizer",
        filename="grounding_dino/tokenizer.json",
        sha256="",
        megabytes=0.7,
        licence="Apache-2.0",
        source="huggingface.co/onnx-community/grounding-dino-tiny-ONNX (tokenizer.json of bert-base-uncased)",
        used_for="masks: the words of the text prompt",
    ),
    PretrainedFile(
        name="sam2_encoder",
        filename="sam2/encoder.onnx",
        sha256="",
        megabytes=130,
        licence="Apache-2.0",
        source="github.com/facebookresearch/sam2, checkpoints of SAM 2.1 (hiera tiny to large)",
        used_for="masks: picture features",
        export=_SAM2_EXPORT.format(part="vision_encoder"),
    ),
    PretrainedFile(
        name="sam2_decoder",
        filename="sam2/decoder.onnx",
        sha256="",
        megabytes=20,
        licence="Apache-2.0",
        source="github.com/facebookresearch/sam2, checkpoints of SAM 2.1 (hiera tiny to large)",
        used_for="masks: from boxes to masks",
        export=_SAM2_EXPORT.format(part="prompt_encoder_mask_decoder"),
    ),
    PretrainedFile(
        name="stablenormal",
        filename="normals/stablenormal.onnx",
        sha256="",
        megabytes=1700,
        licence="Apache-2.0",
        source="github.com/Stable-X/StableNormal (one-step StableNormal_turbo)",
        used_for="normals: monocular normals",
        export=_ANY_EXPORT,
    ),
    PretrainedFile(
        name="dsine",
        filename="normals/dsine.onnx",
        sha256="",
        megabytes=290,
        licence="see the source page",
        source="github.com/baegwangbin/DSINE",
        used_for="normals: monocular normals",
        export=_ANY_EXPORT,
    ),
    PretrainedFile(
        name="omnidata",
        filename="normals/omnidata.onnx",
        sha256="",
        megabytes=490,
        licence="see the source page",
        source="github.com/EPFL-VILAB/omnidata (surface_normal_dpt_hybrid_384)",
        used_for="normals: monocular normals",
        export=_ANY_EXPORT,
    ),
    PretrainedFile(
        name="metric3d",
        filename="normals/metric3d.onnx",
        sha256="",
        megabytes=150,
        licence="BSD-2-Clause",
        source="github.com/YvanYin/Metric3D",
        used_for="normals: monocular normals",
        export="take onnx/model.onnx of the published export onnx-community/metric3d-vit-small",
    ),
)

REGISTRY: dict[str, PretrainedFile] = {**METRICS, **{file.name: file for file in PREPARATION}}
"""All of them by name."""
