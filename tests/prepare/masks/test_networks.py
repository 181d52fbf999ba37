"""GroundingDINO and SAM 2 by tiny networks with their ports, that see a blue ball and understand the word glass."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
pytest.importorskip("tokenizers")

from rtgs.core.errors import RtgsError
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.detect import Box, Detector, PromptTokenizer, Tokens, box_iou, read_boxes, suppress
from rtgs.prepare.masks.segment import Segmenter
from rtgs.prepare.masks.settings import DetectorSettings, SegmenterSettings
from rtgs.prepare.onnx import Network
from tests.prepare import glass_scene, tiny_networks
from tests.prepare.glass_scene import GLASS, WORDS, overlap, shots

SHOT = shots(3)[1]
PICTURE = SHOT.pixels.astype(np.float32) / 255


def exact_box() -> tuple[int, int, int, int]:
    rows, columns = np.nonzero(SHOT.mask)
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory) -> PromptTokenizer:
    return PromptTokenizer(glass_scene.write_tokenizer(tmp_path_factory.mktemp("words") / "tokenizer.json"))


def detect(path: Path, tokenizer: PromptTokenizer, **settings) -> list[Box]:
    chosen = DetectorSettings(**{"short_side": 240, "long_side": 400, **settings})
    return Detector(Network(path, 1), tokenizer, chosen)(PICTURE)


def test_words_become_tokens_and_spans(tokenizer):
    tokens = tokenizer.encode(("glass", "transparent cup"))
    assert [WORDS[index] for index in tokens.ids] == ["[CLS]", "glass", ".", "transparent", "cup", ".", "[SEP]"]
    assert tokens.spans == ((1, 2), (3, 5))
    assert tokens.attention.tolist() == [1] * 7
    assert tokens.types.tolist() == [0] * 7


@pytest.mark.parametrize(("side", "tokens"), [(None, None), (160, None), (200, 24)])
@pytest.mark.parametrize("phrases", ["separate", "together"])
def test_the_box_of_a_word_is_found(tmp_path, tokenizer, side, tokens, phrases):
    """Exports of any size, of a fixed size (the photo is stretched), and of a fixed number of tokens."""
    path = glass_scene.grounding_dino(tmp_path / "dino.onnx", side, tokens)
    (box,) = detect(path, tokenizer, prompt="Wooden chair . GLASS.bottle", phrases=phrases)
    np.testing.assert_allclose((box.left, box.top, box.right, box.bottom), exact_box(), atol=1.5)
    assert box.phrase == "glass"
    assert box.score == pytest.approx(1 / (1 + math.exp(-2)), abs=1e-6)
    assert detect(path, tokenizer, prompt="wooden chair", phrases=phrases) == []
    assert detect(path, tokenizer, prompt="glass", box_threshold=0.9) == []
    assert detect(path, tokenizer, prompt="glass", text_threshold=0.9) == []
    assert detect(path, tokenizer, prompt="glass", max_area=0.01) == []


def test_boxes_are_read_as_the_authors_do():
    tokens = Tokens(np.arange(6), np.zeros(6), np.ones(6), ("a", "b"), ((1, 2), (3, 5)))
    logits = np.full((4, 256), -np.inf)
    logits[0, 1], logits[1, 4], logits[2, 1], logits[3, 3] = 2.0, 1.0, -3.0, 3.0
    logits[:, 2] = 9.0  # the full stop between the phrases is no word
    boxes = np.array([[0.5, 0.5, 0.2, 0.4], [0.9, 0.5, 0.4, 0.4], [0.5, 0.5, 0.2, 0.4], [0.2, 0.2, 0.0, 0.1]])
    found = read_boxes(logits, boxes, tokens, DetectorSettings(), (100, 50))
    assert [box.phrase for box in found] == ["a", "b"], "too unsure, and of no width"
    assert (found[0].left, found[0].top, found[0].right, found[0].bottom) == pytest.approx((40, 15, 60, 35))
    assert found[1].right == 100, "cut at the frame"


def test_overlapping_boxes_are_suppressed():
    boxes = [Box(0, 0, 10, 10, 0.5, "a"), Box(0, 0, 10, 9, 0.9, "b"), Box(20, 0, 30, 10, 0.4, "a")]
    assert [box.score for box in suppress(boxes, 0.8)] == [0.9, 0.4]
    assert box_iou(boxes[0], boxes[1]) == pytest.approx(0.9)
    assert box_iou(boxes[0], boxes[2]) == 0
    assert len(suppress(boxes, 0.95)) == 3


@pytest.mark.parametrize("layout", ["transformers", "samexporter"])
def test_both_layouts_of_sam2_give_the_mask_of_a_box(tmp_path, layout):
    encoder, decoder = (Network(path, 1) for path in glass_scene.sam2(tmp_path, layout))
    segment = Segmenter(encoder, decoder, SegmenterSettings())
    left, top, right, bottom = map(float, exact_box())
    whole = Box(left - 2, top - 2, right + 2, bottom + 2, 0.8, "glass")
    half = Box(left - 2, top - 2, (left + right) / 2, bottom + 2, 0.7, "glass")
    first, second = segment(PICTURE, [whole, half])
    assert segment.layout == layout
    assert first.score == pytest.approx(0.9), "the best of three masks"
    assert first.inside.shape == SHOT.mask.shape
    assert overlap(first.inside, SHOT.mask) > 0.93
    columns = np.arange(SHOT.mask.shape[1]) + 0.5
    cut = SHOT.mask & (columns < (left + right) / 2)
    assert overlap(second.inside, cut) > 0.85, "the prompt is scaled with the photo"
    assert segment(PICTURE, []) == []
    strict = Segmenter(encoder, decoder, SegmenterSettings(min_score=0.95))
    assert strict(PICTURE, [whole]) == []


def test_a_wrong_detector_is_a_message(tmp_path, tokenizer):
    other = glass_scene.grounding_dino(tmp_path / "other.onnx", text="text_ids")
    with pytest.raises(PrepareError, match=r"has no input 'input_ids', but pixel_values \(1, 3, \?, \?\)"):
        detect(other, tokenizer)
    encoder = glass_scene.sam2_encoder(tmp_path / "sam.onnx", "transformers")
    with pytest.raises(PrepareError, match="has no input 'input_ids'"):
        detect(encoder, tokenizer)
    short = glass_scene.grounding_dino(tmp_path / "short.onnx", tokens=4)
    with pytest.raises(PrepareError, match="reads 4 tokens, the prompt has 5"):
        detect(short, tokenizer, prompt="transparent cup")
    helper, constants = tiny_networks.helper, {"zero": np.float32(0)}
    inputs = [("pixel_values", [1, 3, "h", "w"]), ("input_ids", [1, "t"], glass_scene._I64)]
    nodes = [
        helper.make_node("Mul", ["pixel_values", "zero"], ["logits"]),
        helper.make_node("Identity", ["pixel_values"], ["pred_boxes"]),
        helper.make_node("Cast", ["input_ids"], ["unused"], to=1),
    ]
    ports = [("logits", [1, 3, "h", "w"]), ("pred_boxes", [1, 3, "h", "w"])]
    maps = tiny_networks.save(tmp_path / "maps.onnx", nodes, inputs, ports, constants)
    with pytest.raises(PrepareError, match=r"gives logits \(1, 3, .*GroundingDINO's are \(1, Q, 256\)"):
        detect(maps, tokenizer)
    ports[0] = ("text_self_attention_masks", [1, "t"])
    extra = tiny_networks.save(
        tmp_path / "extra.onnx",
        [
            helper.make_node("Mul", ["pixel_values", "zero"], ["logits"]),
            helper.make_node("Add", ["pixel_values", "position_ids"], ["pred_boxes"]),
            helper.make_node("Cast", ["input_ids"], ["unused"], to=1),
        ],
        [*inputs, ("position_ids", [1])],
        [("logits", [1, 3, "h", "w"]), ("pred_boxes", [1, 3, "h", "w"])],
        constants,
    )
    with pytest.raises(PrepareError, match="also wants position_ids: exports of the original repository"):
        detect(extra, tokenizer)


def test_a_wrong_segmenter_is_a_message(tmp_path):
    ours = {layout: glass_scene.sam2(tmp_path / layout, layout) for layout in ("transformers", "samexporter")}
    encoder, decoder = (Network(path, 1) for path in ours["transformers"])
    other = Network(ours["samexporter"][1], 1)
    with pytest.raises(PrepareError, match=r"is no decoder for .*layout of transformers: take both files from one"):
        Segmenter(encoder, other, SegmenterSettings())
    with pytest.raises(PrepareError, match="is no encoder of SAM 2 in the layout of transformers"):
        Segmenter(decoder, decoder, SegmenterSettings())
    helper = tiny_networks.helper
    ports = [(port.name, ["a", "b", "c", "d"]) for port in decoder.inputs]
    nodes = [helper.make_node("Identity", [name], [f"kept {name}"]) for name, _ in ports]
    nodes += [helper.make_node("Identity", ["image_embeddings.0"], ["pred_masks"])]
    nodes += [helper.make_node("Identity", ["image_embeddings.0"], ["iou_scores"])]
    outputs = [("pred_masks", ["a", "b", "c", "d"]), ("iou_scores", ["a", "b", "c", "d"])]
    video = tiny_networks.save(tmp_path / "v.onnx", nodes, [*ports, ("memory", [1])], outputs, {})
    with pytest.raises(PrepareError, match="also wants memory: it is a decoder for videos"):
        Segmenter(encoder, Network(video, 1), SegmenterSettings())
    shapes = [[part or "?" for part in port.shape] for port in decoder.inputs]
    kinds = [[glass_scene._I64] if port.type == "tensor(int64)" else [] for port in decoder.inputs]
    inputs = [(name, shape, *kind) for (name, _), shape, kind in zip(ports, shapes, kinds)]
    many = tiny_networks.save(tmp_path / "m.onnx", nodes, inputs, outputs, {})
    with pytest.raises(PrepareError, match=r"gives pred_masks \(1, 32, 64, 64\) and iou_scores .*it is another model"):
        Segmenter(encoder, Network(many, 1), SegmenterSettings())(PICTURE, [Box(0, 0, 50, 50, 1.0, "glass")])


def test_a_wrong_tokenizer_is_a_message(tmp_path, tokenizer):
    (tmp_path / "text.json").write_text("{}")
    with pytest.raises(PrepareError, match="is no tokenizer file"):
        PromptTokenizer(tmp_path / "text.json")
    strange = glass_scene.write_tokenizer(tmp_path / "strange.json", ("[UNK]", "glass"))
    with pytest.raises(PrepareError, match=r"knows no \[CLS\], \[SEP\] or '\.'"):
        PromptTokenizer(strange)
    with pytest.raises(PrepareError, match=r"is 262 tokens long, GroundingDINO reads 256"):
        tokenizer.encode(("glass",) * 130)
    with pytest.raises(PrepareError, match="makes 1 phrases of"):
        tokenizer.encode(("glass", "\u200b"))


@pytest.mark.parametrize(
    ("make_settings", "message"),
    [
        (lambda: DetectorSettings(prompt=" . "), "what to look for"),
        (lambda: DetectorSettings(phrases="apart"), "masks.detector.phrases='apart'"),
        (lambda: DetectorSettings(box_threshold=1.5), "must be between 0 and 1"),
        (lambda: SegmenterSettings(size=8), "masks.segmenter.size=8 must be at least 64"),
    ],
)
def test_settings_out_of_range_are_refused(make_settings, message):
    with pytest.raises(RtgsError, match=message):
        make_settings()


def test_the_network_hears_only_its_word():
    assert WORDS[GLASS] == "glass"
