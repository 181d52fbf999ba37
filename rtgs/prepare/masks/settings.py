"""Where the masks of transparent objects come from: the schema of the ``masks`` config group."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.errors import RtgsError
from rtgs.core.refuse import refuse_below, refuse_unknown_words, refuse_unless

MaskSource = Literal["auto", "none", "given", "grounded_sam2", "grabcut", "polygon"]
MaskLayout = Literal["files", "alpha"]
CleanAction = Literal["auto", "flag", "repair", "drop"]


@dataclass(frozen=True)
class DetectorSettings:
    """Boxes from words: GroundingDINO (Liu et al. 2023)."""

    prompt: str = "glass . bottle . transparent cup"
    """Phrases separated by full stops, in English, lower case."""
    box_threshold: float = 0.35
    """Least score of a box: the largest sigmoid over the words of its phrase (0.35 in the authors' README)."""
    text_threshold: float = 0.25
    """Least score of the phrase a box is named after, where phrases are asked for together (0.25 ibid.)."""
    nms_iou: float = 0.8
    """Of two boxes that overlap more, the one with the lower score goes (0.8 in Grounded-Segment-Anything's demo)."""
    max_area: float = 0.9
    """Boxes that cover more of the photo are left out: that is the room, not an object."""
    max_boxes: int = 20
    """In one photo, best first."""
    phrases: Literal["separate", "together"] = "separate"
    """``separate``: one pass for each phrase. ``together``: one pass for all, quicker, and wrong with the export that
    most people use, which was traced with one phrase and sees only the first."""
    short_side: int = 800
    long_side: int = 1333
    """The photo is scaled to them where the network takes any size (the authors' preprocessing); exports of a fixed
    size get the photo stretched to it."""
    file: str = ""
    """ONNX file. Empty: the registered name in the folders of weights (``rtgs weights status``)."""
    tokenizer: str = ""
    """Its ``tokenizer.json``. Empty: the registered name, or that beside ``file``."""

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "masks.detector")
        for key in ("box_threshold", "text_threshold", "nms_iou", "max_area"):
            _refuse_no_share(f"masks.detector.{key}", getattr(self, key))
        refuse_below("masks.detector.max_boxes", self.max_boxes, 1)
        refuse_below("masks.detector.short_side", self.short_side, 32)
        refuse_below("masks.detector.long_side", self.long_side, self.short_side)
        named = any(part.strip() for part in self.prompt.split("."))
        refuse_unless(named, "masks.detector.prompt", repr(self.prompt), "what to look for, such as 'glass . bottle'")


@dataclass(frozen=True)
class SegmenterSettings:
    """Masks from boxes: SAM 2 (Ravi et al. 2024), each photo by itself."""

    size: int = 1024
    """Side of the square the photo is stretched to, where the encoder's export leaves it open."""
    mask_threshold: float = 0.0
    """Logits above it are inside (the authors' predictor)."""
    min_score: float = 0.5
    """Least predicted IoU of a mask; of the three masks for a box the one with the best score is taken."""
    encoder: str = ""
    decoder: str = ""
    """ONNX files. Empty: the registered names in the folders of weights."""

    def __post_init__(self) -> None:
        refuse_below("masks.segmenter.size", self.size, 64)
        _refuse_no_share("masks.segmenter.min_score", self.min_score)


@dataclass(frozen=True)
class GivenSettings:
    """Masks somebody painted or another tool made."""

    folder: str = ""
    """Folder of the masks, relative to the capture. Empty: ``scene.masks_dir``."""
    layout: MaskLayout = "files"
    """``files``: one mask file for each photo. ``alpha``: the alpha channel of the photos themselves."""
    labels: tuple[int, ...] = ()
    """Label images: the values (grey level, or palette index) that mean glass. Empty: not label images."""
    label_colors: tuple[str, ...] = ()
    """Label images in colour: the colours that mean glass, as ``"#00ff40"``."""
    threshold: float = -1.0
    """A pixel is inside where its brightest channel is above this share of the range. -1: 0 for PNG and the like, 0.5
    for JPEG, whose zeros are not clean."""
    inverted: bool = False
    """The masks mark everything but the object (COLMAP's own masks do: black is left out)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "labels", tuple(self.labels))
        object.__setattr__(self, "label_colors", tuple(self.label_colors))
        refuse_unknown_words(self, "masks.given")
        share = self.threshold == -1 or 0 <= self.threshold < 1
        refuse_unless(share, "masks.given.threshold", self.threshold, "a share in [0, 1), or -1")
        for color in self.label_colors:
            parse_color(color)
        if self.labels and self.label_colors:
            raise RtgsError("masks.given.labels and masks.given.label_colors exclude each other")


@dataclass(frozen=True)
class DrawnSettings:
    """The classical fallback: what a person marked in a few photos, in a file beside them."""

    file: str = "masks.yaml"
    """Relative to the capture; YAML or JSON (docs/prepare.md)."""
    grabcut_rounds: int = 6
    """Iterations of GrabCut (Rother et al. 2004); it has converged by then on ordinary photos."""
    grabcut_side: int = 600
    """Long side GrabCut works at; its time grows with the number of pixels."""
    carry: bool = True
    """Photos without marks get theirs from the hull of the marked ones (three at least): its silhouette where all are
    outlined, else what GrabCut makes of it."""
    click_radius: float = 0.01
    """Of a click, in long sides of the photo."""
    min_angle: float = 2.0
    """Degrees between the rays to a corner of a pane below which its depth is not believed."""
    frame: float = 0.3
    """Of a pane's size: how far its frame reaches beyond it, whose points give the plane where it is drawn once."""
    max_error: float = 0.01
    """Distance between a drawn corner and the carried one, in long sides of the photo, above which a warning names the
    photo."""

    def __post_init__(self) -> None:
        refuse_below("masks.drawn.grabcut_rounds", self.grabcut_rounds, 1)
        refuse_below("masks.drawn.grabcut_side", self.grabcut_side, 64)
        refuse_below("masks.drawn.min_angle", self.min_angle, 0.0)
        _refuse_no_share("masks.drawn.click_radius", self.click_radius)
        _refuse_no_share("masks.drawn.max_error", self.max_error)
        refuse_below("masks.drawn.frame", self.frame, 0.05)


@dataclass(frozen=True)
class CleanSettings:
    """Masks against each other: the visual hull of all of them, seen from every photo."""

    action: CleanAction = "auto"
    """``flag``: tell only. ``repair``: inside what the hull rules in, outside what it rules out. ``drop``: the photo
    goes without a mask. ``auto``: repair masks made here, flag given ones."""
    voxels: int = 64
    """On the long side of the hull's box; 96 gives a container to 0.003 of its size, 64 is plenty to
    find a wrong mask."""
    mask_size: int = 320
    """Long side of the masks it works with."""
    tolerated: float = 0.06
    """Share of the photos that may be wrong about a voxel: the (k+1)-th smallest signed distance decides, k = 2 to 3
    for 40 photos of estimated masks. Twice and four times as many where the masks have no hull in common."""
    min_views: int = 5
    """Photos with a mask below which nothing is checked."""
    min_agreement: float = 0.75
    """IoU of a mask with the hull's silhouette, edges forgiven, below which it is flagged."""

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "masks.clean")
        refuse_below("masks.clean.voxels", self.voxels, 16)
        refuse_below("masks.clean.mask_size", self.mask_size, 64)
        refuse_below("masks.clean.min_views", self.min_views, 3)
        _refuse_no_share("masks.clean.min_agreement", self.min_agreement)
        refuse_unless(0 <= self.tolerated <= 0.4, "masks.clean.tolerated", self.tolerated, "in [0, 0.4]")


@dataclass(frozen=True)
class MaskSettings:
    """Masks of transparent objects (method.md 7).

    Raises:
        RtgsError: a value outside its documented range.
    """

    source: MaskSource = "auto"
    """``none``; ``given``: read and checked as ``given`` says; ``grounded_sam2``: from words, by networks;
    ``grabcut``, ``polygon``: from marks in a few photos. ``auto``: nothing where the capture brings masks or has no
    glass; the marks where their file is there; the networks where the method reads masks and their files are there."""
    detector: DetectorSettings = field(default_factory=DetectorSettings)
    segmenter: SegmenterSettings = field(default_factory=SegmenterSettings)
    given: GivenSettings = field(default_factory=GivenSettings)
    drawn: DrawnSettings = field(default_factory=DrawnSettings)
    clean: CleanSettings = field(default_factory=CleanSettings)

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "masks")


def parse_color(text: str) -> tuple[int, int, int]:
    """Red, green, blue in 0..255 of ``#rrggbb``.

    Raises:
        RtgsError: another form.
    """
    digits = text.removeprefix("#")
    try:
        if len(digits) != 6:
            raise ValueError
        return int(digits[:2], 16), int(digits[2:4], 16), int(digits[4:], 16)
    except ValueError:
        raise RtgsError(f"masks.given.label_colors: {text!r} is no colour such as '#00ff40'") from None


def _refuse_no_share(key: str, value: float) -> None:
    refuse_unless(0 <= value <= 1, key, value, "between 0 and 1")
