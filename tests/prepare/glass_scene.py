"""A blue ball in the corner of a room, ray-cast with its exact masks; and networks of a few nodes that see blue."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper
from PIL import Image
from scipy.spatial.transform import Rotation
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors

from tests.prepare import tiny_networks
from tests.prepare.room import Pose, look, photo

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
CENTER, RADIUS = np.array([0.75, 0.75, 0.65]), 0.45
WORDS = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", ".", "glass", "bottle", "transparent", "cup", "wooden", "chair")
GLASS = WORDS.index("glass")


@dataclass(frozen=True)
class Shot:
    """One photo: pixels (H, W, 3) uint8 and the exact mask of the ball."""

    name: str
    pose: Pose
    pixels: np.ndarray
    mask: np.ndarray


def poses(count: int) -> list[Pose]:
    """Cameras on a quarter of a ring before the corner, high and low."""
    result = []
    for index in range(count):
        angle = math.radians(5 + 80 * index / max(count - 1, 1))
        height = 0.5 + 2.0 * (index % 3) / 2
        result.append(look((3.2 * math.cos(angle), 3.2 * math.sin(angle), height), (0.75, 0.75, 0.6)))
    return result


def ball_mask(pose: Pose, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """(H, W) bool."""
    focal = FOCAL * width / WIDTH
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x / focal, y / focal, np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    middle = pose.rotation @ CENTER + pose.translation
    along = rays @ middle
    return (along > 0) & (middle @ middle - along**2 < RADIUS**2)


def shots(count: int, width: int = WIDTH, height: int = HEIGHT) -> list[Shot]:
    """Photos of the room with the ball; the room is grey, so that blue means ball."""
    result = []
    for index, pose in enumerate(poses(count)):
        room = np.repeat(photo(pose, width=width, height=height).mean(axis=-1, keepdims=True), 3, axis=-1)
        mask = ball_mask(pose, width, height)
        result.append(Shot(f"photo_{index:02d}.png", pose, np.where(mask[..., None], [10, 30, 250], room), mask))
    return [Shot(shot.name, shot.pose, shot.pixels.astype(np.uint8), shot.mask) for shot in result]


def write_capture(root: Path, taken: list[Shot], lens: str = "", points: np.ndarray | None = None) -> Path:
    """Photos beside a COLMAP text model with a few points on floor and walls (or ``points``)."""
    (root / "images").mkdir(parents=True)
    (root / "sparse/0").mkdir(parents=True)
    lines = []
    for index, shot in enumerate(taken):
        Image.fromarray(shot.pixels).save(root / "images" / shot.name)
        x, y, z, w = Rotation.from_matrix(shot.pose.rotation).as_quat()
        numbers = " ".join(f"{value:.12f}" for value in (w, x, y, z, *shot.pose.translation))
        lines += [f"{index + 1} {numbers} 1 {shot.name}", ""]
    height, width = taken[0].mask.shape
    focal = FOCAL * width / WIDTH
    plain = f"PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}"
    (root / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    (root / "sparse/0/cameras.txt").write_text(f"1 {lens or plain}\n")
    if points is None:
        points = np.random.default_rng(0).random((200, 3)) * 2
        points[np.arange(200), np.arange(200) % 3] = 0
    rows = [f"{i + 1} {p[0]:.6f} {p[1]:.6f} {p[2]:.6f} 200 100 50 0.5" for i, p in enumerate(points)]
    (root / "sparse/0/points3D.txt").write_text("\n".join(rows) + "\n")
    return root


def write_masks(folder: Path, masks: dict[str, np.ndarray]) -> None:
    """Masks as PNG, by file name."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, mask in masks.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask.astype(np.uint8) * 255).save(folder / name)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union."""
    return float((a & b).sum() / max((a | b).sum(), 1))


def write_tokenizer(path: Path, words: tuple[str, ...] = WORDS) -> Path:
    """A WordPiece tokenizer of a few words, put together as BERT's."""
    tokenizer = Tokenizer(models.WordPiece({word: index for index, word in enumerate(words)}, unk_token="[UNK]"))
    tokenizer.normalizer = normalizers.BertNormalizer(lowercase=True)
    tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    if "[CLS]" in words:
        ends = [(word, words.index(word)) for word in ("[CLS]", "[SEP]")]
        tokenizer.post_processor = processors.TemplateProcessing(single="[CLS] $A [SEP]", special_tokens=ends)
    path.parent.mkdir(parents=True, exist_ok=True)
    tokenizer.save(str(path))
    return path


_MEAN, _STD = np.array((0.485, 0.456, 0.406)), np.array((0.229, 0.224, 0.225))
_BLUE = np.array([-1.0, 0.0, 1.0])  # blue minus red, of the picture before it was normalised
_BLUE_WEIGHTS = (_BLUE * _STD)[None, :, None, None].astype(np.float32)
_BLUE_BIAS = np.array([_BLUE @ _MEAN - 0.5], dtype=np.float32)
_I64 = TensorProto.INT64


def grounding_dino(path: Path, side: int | None = None, tokens: int | None = None, text: str = "input_ids") -> Path:
    """GroundingDINO's ports: query 0 is the box around all blue, sure of the word "glass"; query 1 sees nothing.

    ``side``, ``tokens``: sizes the export is fixed to.
    """
    node = helper.make_node
    nodes = [
        node("Conv", ["pixel_values", "weights", "bias"], ["blue"]),
        node("Greater", ["blue", "zero"], ["is_blue"]),
        node("Cast", ["is_blue"], ["inside"], to=TensorProto.FLOAT),
        node("ReduceMax", ["inside"], ["columns4"], axes=[1, 2], keepdims=0),
        node("ReduceMax", ["inside"], ["rows4"], axes=[1, 3], keepdims=0),
        node("ReduceMax", ["inside"], ["any"], axes=[0, 1, 2, 3], keepdims=0),
        node("Shape", ["pixel_values"], ["shape"]),
        node("Cast", ["shape"], ["sizes"], to=TensorProto.FLOAT),
    ]
    for name, index in (("columns", 3), ("rows", 2)):
        nodes += [
            node("ArgMax", [f"{name}4"], [f"{name}_first"], axis=1, keepdims=0),
            node("ArgMax", [f"{name}4"], [f"{name}_last"], axis=1, keepdims=0, select_last_index=1),
            node("Cast", [f"{name}_first"], [f"{name}_low"], to=TensorProto.FLOAT),
            node("Cast", [f"{name}_last"], [f"{name}_end"], to=TensorProto.FLOAT),
            node("Add", [f"{name}_end", "one"], [f"{name}_high"]),
            node("Gather", ["sizes", f"axis{index}"], [f"{name}_size"]),
            node("Add", [f"{name}_low", f"{name}_high"], [f"{name}_sum"]),
            node("Mul", [f"{name}_sum", "half"], [f"{name}_mid"]),
            node("Sub", [f"{name}_high", f"{name}_low"], [f"{name}_span"]),
            node("Div", [f"{name}_mid", f"{name}_size"], [f"{name}_c"]),
            node("Div", [f"{name}_span", f"{name}_size"], [f"{name}_s"]),
        ]
    nodes += [
        node("Concat", ["columns_c", "rows_c", "columns_s", "rows_s"], ["box"], axis=0),
        node("Concat", ["box", "whole"], ["both"], axis=0),
        node("Reshape", ["both", "box_shape"], ["pred_boxes"]),
        node("Equal", [text, "glass"], ["is_glass"]),
        node("Cast", ["is_glass"], ["word"], to=TensorProto.FLOAT),
        node("Cast", ["attention_mask"], ["attended"], to=TensorProto.FLOAT),
        node("Mul", ["word", "attended"], ["heard"]),
        node("Mul", ["heard", "any"], ["seen"]),
        node("Mul", ["seen", "ten"], ["strong"]),
        node("Sub", ["strong", "eight"], ["sure"]),
        node("Unsqueeze", ["sure", "axis1"], ["query0"]),
        node("Mul", ["query0", "zero"], ["nothing"]),
        node("Sub", ["nothing", "eight"], ["query1"]),
        node("Concat", ["query0", "query1"], ["short"], axis=1),
        node("Shape", ["short"], ["short_shape"]),
        node("Gather", ["short_shape", "axis2"], ["length"]),
        node("Sub", ["full", "length"], ["room"]),
        node("Concat", ["zeros5", "room"], ["pads"], axis=0),
        node("Pad", ["short", "pads", "never"], ["logits"]),
        # the two other inputs are read, as in the real graph
        node("Cast", ["pixel_mask"], ["mask_values"], to=TensorProto.FLOAT),
        node("Cast", ["token_type_ids"], ["types"], to=TensorProto.FLOAT),
        node("ReduceSum", ["mask_values"], ["mask_total"], keepdims=0),
        node("ReduceSum", ["types"], ["type_total"], keepdims=0),
    ]
    floats = {"zero": 0.0, "one": 1.0, "half": 0.5, "ten": 10.0, "eight": 8.0, "never": -np.inf}
    constants = {name: np.float32(value) for name, value in floats.items()}
    constants |= {
        "weights": _BLUE_WEIGHTS,
        "bias": _BLUE_BIAS,
        "whole": np.float32([0.5, 0.5, 0.2, 0.2]),
        "box_shape": np.array([1, 2, 4], dtype=np.int64),
        "glass": np.int64(GLASS),
        "axis1": np.array([1], dtype=np.int64),
        "axis2": np.array([2], dtype=np.int64),
        "axis3": np.array([3], dtype=np.int64),
        "full": np.array([256], dtype=np.int64),
        "zeros5": np.zeros(5, dtype=np.int64),
    }
    height, width, length = side or "h", side or "w", tokens or "t"
    inputs = [
        ("pixel_values", [1, 3, height, width]),
        (text, [1, length], _I64),
        ("token_type_ids", [1, length], _I64),
        ("attention_mask", [1, length], _I64),
        ("pixel_mask", [1, height, width], _I64),
    ]
    return tiny_networks.save(path, nodes, inputs, [("logits", [1, 2, 256]), ("pred_boxes", [1, 2, 4])], constants)


SAM_SIDE = 256
_LOW = SAM_SIDE // 4
_FEATURES = {
    "transformers": ("image_embeddings.0", "image_embeddings.1", "image_embeddings.2"),
    "samexporter": ("high_res_feats_0", "high_res_feats_1", "image_embed"),
}
_CHANNELS = (32, 64, 256)


def sam2(folder: Path, layout: str) -> tuple[Path, Path]:
    """Encoder and decoder with SAM 2's ports: what is blue inside the box, the second of three masks."""
    return sam2_encoder(folder / "encoder.onnx", layout), sam2_decoder(folder / "decoder.onnx", layout)


def sam2_encoder(path: Path, layout: str) -> Path:
    """Features of three sizes whose first channel is blueness."""
    picture = "pixel_values" if layout == "transformers" else "image"
    nodes, constants = [], {}
    for level, (name, channels) in enumerate(zip(_FEATURES[layout], _CHANNELS)):
        step = 4 * 2**level
        nodes += [
            helper.make_node("Conv", [picture, f"w{level}", f"b{level}"], [f"blue{level}"]),
            helper.make_node("AveragePool", [f"blue{level}"], [name], kernel_shape=[step, step], strides=[step, step]),
        ]
        constants |= {
            f"w{level}": np.repeat(_BLUE_WEIGHTS, channels, axis=0),
            f"b{level}": np.repeat(_BLUE_BIAS, channels),
        }
    outputs = [(name, shape) for name, shape in zip(_FEATURES[layout], _feature_shapes())]
    return tiny_networks.save(path, nodes, [(picture, [1, 3, SAM_SIDE, SAM_SIDE])], outputs, constants)


def _feature_shapes() -> list[list[int]]:
    return [[1, channels, _LOW >> level, _LOW >> level] for level, channels in enumerate(_CHANNELS)]


def sam2_decoder(path: Path, layout: str) -> Path:
    """Masks of logits for a box, and their scores."""
    node = helper.make_node
    features = list(zip(_FEATURES[layout], _feature_shapes()))
    if layout == "transformers":
        prompts = [("input_points", [1, 1, "p", 2]), ("input_labels", [1, 1, "p"], _I64), ("input_boxes", [1, "b", 4])]
        outputs = [("pred_masks", [1, "b", 3, _LOW, _LOW]), ("iou_scores", [1, "b", 3])]
        head = [
            node("ReduceSum", ["input_points"], ["points_sum"], keepdims=0),
            node("Mul", ["points_sum", "zero"], ["unused"]),
            node("Identity", ["input_boxes"], ["corners"]),
        ]
    else:
        prompts = [
            ("point_coords", [1, "p", 2]),
            ("point_labels", [1, "p"]),
            ("mask_input", [1, 1, _LOW, _LOW]),
            ("has_mask_input", [1]),
        ]
        outputs = [("masks", [1, 3, _LOW, _LOW]), ("iou_predictions", [1, 3])]
        head = [
            node("Sub", ["point_labels", "two_three"], ["wrong_labels"]),  # anything but 2, 3 spoils the scores
            node("Abs", ["wrong_labels"], ["wrong"]),
            node("ReduceSum", ["wrong"], ["wrong_sum"], keepdims=0),
            node("Neg", ["wrong_sum"], ["unused"]),
            node("Reshape", ["point_coords", "box_shape"], ["corners"]),
        ]
    nodes = [
        *head,
        node("Split", ["corners"], ["left", "top", "right", "bottom"], axis=2),
        *(node("Unsqueeze", [name, "last"], [f"{name}4"]) for name in ("left", "top", "right", "bottom")),
        node("Greater", ["across", "left4"], ["after"]),
        node("Less", ["across", "right4"], ["before"]),
        node("Greater", ["down", "top4"], ["below"]),
        node("Less", ["down", "bottom4"], ["above"]),
        node("And", ["after", "before"], ["in_columns"]),
        node("And", ["below", "above"], ["in_rows"]),
        node("And", ["in_columns", "in_rows"], ["in_box"]),
        node("Conv", [features[0][0], "first"], ["blue"]),
        node("Where", ["in_box", "blue", "far_out"], ["good4"]),
        node("Unsqueeze", ["good4", "second"], ["good"]),
        node("Neg", ["good"], ["bad"]),
        node("Sub", ["bad", "one"], ["worse"]),
        node("Concat", ["bad", "good", "worse"], ["three"], axis=2),
        node("Mul", ["left", "zero"], ["blank"]),
        node("Add", ["blank", "ranks"], ["ranked"]),
        node("Add", ["ranked", "unused"], ["scored"]),
    ]
    tail = (("three", "masks", "mask_shape"), ("scored", "iou_predictions", "score_shape"))
    if layout == "transformers":
        nodes += [node("Identity", ["three"], ["pred_masks"]), node("Identity", ["scored"], ["iou_scores"])]
    else:
        nodes += [node("Reshape", [source, shape], [name]) for source, name, shape in tail]
    centres = (np.arange(_LOW, dtype=np.float32) + 0.5) * 4
    first = np.zeros((1, _CHANNELS[0], 1, 1), dtype=np.float32)
    first[0, 0] = 20
    constants = {
        "zero": np.float32(0),
        "one": np.float32(1),
        "two_three": np.float32([2, 3]),
        "far_out": np.float32(-30),
        "box_shape": np.array([1, 1, 4], dtype=np.int64),
        "last": np.array([3], dtype=np.int64),
        "second": np.array([2], dtype=np.int64),
        "across": centres.reshape(1, 1, 1, -1),
        "down": centres.reshape(1, 1, -1, 1),
        "first": first,
        "ranks": np.float32([[[0.3, 0.9, 0.2]]]),
        "mask_shape": np.array([1, 3, _LOW, _LOW], dtype=np.int64),
        "score_shape": np.array([1, 3], dtype=np.int64),
    }
    return tiny_networks.save(path, nodes, [*features, *prompts], outputs, constants)


def write_networks(weights: Path, layout: str = "transformers") -> None:
    """All four files under their registered names."""
    grounding_dino(weights / "grounding_dino/model.onnx")
    write_tokenizer(weights / "grounding_dino/tokenizer.json")
    sam2(weights / "sam2", layout)
