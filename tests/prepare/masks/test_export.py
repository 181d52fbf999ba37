"""The real model classes at a tiny size, random weights: exported, and run by the code that makes masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
pytest.importorskip("tokenizers")
transformers = pytest.importorskip("transformers")

from transformers.models.grounding_dino import modeling_grounding_dino  # noqa: E402

from rtgs.prepare.errors import PrepareError  # noqa: E402
from rtgs.prepare.masks.detect import Box, Detector, PromptTokenizer, imagenet_batch, read_boxes  # noqa: E402
from rtgs.prepare.masks.onnx_export import export, phrase_masks  # noqa: E402
from rtgs.prepare.masks.segment import Segmenter  # noqa: E402
from rtgs.prepare.masks.settings import DetectorSettings, SegmenterSettings  # noqa: E402
from rtgs.prepare.onnx import Network  # noqa: E402
from tests.prepare import glass_scene  # noqa: E402
from tests.prepare.glass_scene import SAM_SIDE  # noqa: E402

PHOTO = np.random.default_rng(0).random((60, 90, 3), dtype=np.float32)
SPECIAL = [101, 102, 1012, 1029]


def randomize(model: torch.nn.Module, spread: float) -> None:
    generator = torch.Generator().manual_seed(0)
    for parameter in model.parameters():
        if parameter.dim() > 1:
            parameter.data.normal_(0, spread, generator=generator)


def test_phrases_are_masked_as_transformers_does():
    generator = torch.Generator().manual_seed(0)
    rows = [[101, 5, 1012, 102], [101, 5, 6, 1012, 7, 1012, 102, 0, 0], [5, 6, 7], [1012, 5, 1012, 1029, 6, 102]]
    drawn = torch.randint(0, 4, (40, 9), generator=generator)
    rows += torch.tensor([5, 1012, 101, 6])[drawn].tolist()
    for row in rows:
        ids, special = torch.tensor([row]), torch.tensor(SPECIAL)
        expected = modeling_grounding_dino.generate_masks_with_special_tokens_and_transfer_map(ids, special)
        for ours, theirs in zip(phrase_masks(ids, special), expected):
            assert torch.equal(ours, theirs), row


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """Both models as transformers saves them, exported by the command's own function."""
    folder = tmp_path_factory.mktemp("real")
    swin = transformers.SwinConfig(
        image_size=96, embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 2, 2, 2], window_size=4,
        out_features=["stage2", "stage3", "stage4"],
    )  # fmt: skip
    bert = transformers.BertConfig(
        vocab_size=1100, hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=16
    )
    dino = transformers.GroundingDinoForObjectDetection(
        transformers.GroundingDinoConfig(
            backbone_config=swin, text_config=bert, d_model=32, num_queries=12, encoder_layers=1, decoder_layers=2,
            encoder_ffn_dim=32, decoder_ffn_dim=32, encoder_attention_heads=2, decoder_attention_heads=2,
            encoder_n_points=2, decoder_n_points=2, disable_custom_kernels=True,
        )
    )  # fmt: skip
    randomize(dino, 0.2)
    dino.save_pretrained(folder / "dino")
    write_real_tokenizer(folder / "dino/tokenizer.json")
    hiera = transformers.Sam2HieraDetConfig(
        hidden_size=8, image_size=[SAM_SIDE] * 2, blocks_per_stage=[1, 1, 2, 1], embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 1, 2, 2], global_attention_blocks=[3], window_size_per_stage=[8, 4, 4, 4],
    )  # fmt: skip
    vision = transformers.Sam2VisionConfig(
        backbone_config=hiera,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[SAM_SIDE // 4] * 2, [SAM_SIDE // 8] * 2, [SAM_SIDE // 16] * 2],
        fpn_hidden_size=32,
    )
    prompts = transformers.Sam2PromptEncoderConfig(hidden_size=32, image_size=SAM_SIDE)
    decoder = transformers.Sam2MaskDecoderConfig(
        hidden_size=32, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=32
    )
    sam = transformers.Sam2Model(
        transformers.Sam2Config(vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=decoder)
    )
    randomize(sam, 0.3)
    sam.save_pretrained(folder / "sam")
    written = [*export(folder / "dino", folder / "weights", side=128), *export(folder / "sam", folder / "weights")]
    assert all(path.is_file() for path in written)
    return folder


def write_real_tokenizer(path: Path) -> None:
    """Words with the ids of BERT's special tokens."""
    words = [f"[unused{index}]" for index in range(1100)]
    for index, word in {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 1012: ".", 5: "glass", 6: "cup"}.items():
        words[index] = word
    glass_scene.write_tokenizer(path, tuple(words))


def test_grounding_dino_gives_the_boxes_that_transformers_gives(weights):
    settings = DetectorSettings(prompt="glass . cup glass", phrases="together", box_threshold=0.0, text_threshold=0.0)
    settings = DetectorSettings(**{**settings.__dict__, "nms_iou": 1.0, "max_area": 1.0, "max_boxes": 100})
    tokenizer = PromptTokenizer(weights / "weights/grounding_dino/tokenizer.json")
    network = Network(weights / "weights/grounding_dino/model.onnx", 1)
    found = Detector(network, tokenizer, settings)(PHOTO)
    tokens = tokenizer.encode(("glass", "cup glass"))
    assert tokens.ids.tolist() == [101, 5, 1012, 6, 5, 1012, 102]
    model = transformers.GroundingDinoForObjectDetection.from_pretrained(weights / "dino").eval()
    side = network.input("pixel_values").shape[2]
    with torch.no_grad():
        expected = model(
            torch.from_numpy(imagenet_batch(PHOTO, side, side)),
            *(torch.from_numpy(part)[None] for part in (tokens.ids, tokens.types, tokens.attention)),
        )
    theirs = read_boxes(expected.logits[0].numpy(), expected.pred_boxes[0].numpy(), tokens, settings, (90, 60))
    assert len(found) == len(theirs) > 3
    values = [[box.score, box.left, box.top, box.right, box.bottom] for box in found]
    others = [[box.score, box.left, box.top, box.right, box.bottom] for box in sorted(theirs, key=lambda b: -b.score)]
    np.testing.assert_allclose(values, others, atol=2e-2)


def test_sam2_gives_the_mask_that_transformers_gives(weights):
    model = transformers.Sam2Model.from_pretrained(weights / "sam").eval()
    corners = torch.tensor([[[20.0, 15.0, 70.0, 45.0]]]) * torch.tensor([SAM_SIDE / 90, SAM_SIDE / 60] * 2)
    pixels = torch.from_numpy(imagenet_batch(PHOTO, SAM_SIDE, SAM_SIDE))
    with torch.no_grad():
        theirs = model(pixel_values=pixels, input_boxes=corners)
    best = int(theirs.iou_scores[0, 0].argmax())
    logits = torch.nn.functional.interpolate(theirs.pred_masks[0, 0, best][None, None], size=(60, 90), mode="bilinear")
    middle = float(logits.median())
    encoder, decoder = (Network(weights / f"weights/sam2/{part}.onnx", 1) for part in ("encoder", "decoder"))
    segment = Segmenter(encoder, decoder, SegmenterSettings(min_score=0.0, mask_threshold=middle))
    (ours,) = segment(PHOTO, [Box(20.0, 15.0, 70.0, 45.0, 1.0, "glass")])
    assert ours.score == pytest.approx(float(theirs.iou_scores[0, 0, best]), abs=1e-3)
    assert ours.inside.mean() == pytest.approx(0.5, abs=0.01)
    assert ((logits[0, 0] > middle).numpy() == ours.inside).mean() > 0.995


def test_what_is_no_checkpoint_is_a_message(tmp_path):
    with pytest.raises(PrepareError, match=r"holds no config.json: name the folder of a checkpoint"):
        export(tmp_path, tmp_path / "weights")
    transformers.BertConfig().save_pretrained(tmp_path / "bert")
    with pytest.raises(PrepareError, match="is a bert: only GroundingDINO and SAM 2 make masks"):
        export(tmp_path / "bert", tmp_path / "weights")
