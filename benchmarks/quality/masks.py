"""How far the clean-up of masks and the fallback without networks can be trusted, on scenes whose masks are known.

``python -m benchmarks.quality.masks [SCENE ...] [--spoilt 0.15]``: on each embedded scene with glass, every mask is
compared with the hull of all: first the true masks (none should be flagged), then with a share of them spoilt (half
missing, moved, empty, far too large), which should be found and repaired. Then by hand: GrabCut from boxes around the
true masks in three photos and in all, and the hull of eight true outlines. ``--networks FOLDER`` instead times
GroundingDINO and SAM 2 (``--part``: one of them) at their real size (tiny variants) with random weights, exported into
FOLDER where they are not there yet (needs transformers): seconds and memory do not depend on the weights. ``--clock``:
the glass door of ``glass_clock`` in ``$RTGS_SHARED/data``, drawn in one or two photos and carried to others. The last
line is a JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.machine import machine, peak_memory_mb
from rtgs.prepare.masks.hull import in_form
from rtgs.prepare.masks.make import MaskRequest, make_masks, mask_path, write_mask
from rtgs.prepare.masks.report import MaskReport
from rtgs.prepare.masks.settings import CleanSettings, DrawnSettings, GivenSettings, MaskSettings
from rtgs.scenes.images import nearest_resize, read_mask
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.settings import SceneSettings

SCENES = ("ball_statue", "popcorn_cup", "real_bottle", "tall_bottle")
PARTS = ("segmenter", "detector")
CLOCK_MARKS = Path(__file__).parents[1] / "marks" / "glass_clock.yaml"


@dataclass(frozen=True)
class Row:
    """Figures of one scene; IoU against the true masks, means over the photos named."""

    scene: str
    photos: int
    agreement: float  # of the true masks with their hull, the least
    false_alarms: int  # true masks that are flagged
    spoilt: int
    found: int  # spoilt masks that are flagged
    wrongly: int  # good masks that are flagged beside them
    spoilt_iou: float  # of the spoilt masks
    repaired_iou: float  # of the same after repair
    grabcut_three: float  # from three boxes, all photos
    grabcut_all: float  # from a box in every photo
    outlined: float  # photos without marks, from exact outlines in eight others
    seconds: float  # CPU, of one comparison of all masks


def spoil(mask: np.ndarray, kind: int) -> np.ndarray:
    """A mask as a network gets it wrong."""
    import cv2

    _, columns = np.nonzero(mask)
    wrong = mask.copy()
    if kind == 0:
        wrong[:, int(columns.mean()) :] = False
    elif kind == 1:
        wrong = np.roll(mask, int(0.4 * np.ptp(columns)) + 2, axis=1)
    elif kind == 2:
        wrong[:] = False
    else:
        reach = int(0.5 * np.sqrt(mask.sum())) | 1
        wrong = cv2.dilate(mask.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    return wrong


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union."""
    return float((a & b).sum() / max((a | b).sum(), 1))


def run(scene: str, method: str, settings: MaskSettings, source: Path, out: Path) -> MaskReport:
    """One run of the step's function."""
    out.mkdir()
    request = MaskRequest(method, SceneSettings(path=f"embedded:{scene}"), settings, source, out / "cache", 1)
    return make_masks(request, out, lambda line: None)


def measure(scene: str, share: float, folder: Path) -> Row:
    """All figures of a scene."""
    views = read_capture(SceneSettings(path=f"embedded:{scene}")).views
    truth = {view.name: read_mask(view.mask) for view in views if view.mask is not None}
    rng = np.random.default_rng(0)
    chosen = sorted(rng.choice(sorted(truth), max(1, round(share * len(truth))), replace=False))
    bad = {name: spoil(truth[name], index % 4) for index, name in enumerate(chosen)}
    for name, mask in truth.items():
        write_mask(mask, mask_path(folder / "good", name))
        write_mask(bad.get(name, mask), mask_path(folder / "bad", name))
    settings = MaskSettings(given=GivenSettings(folder="masks"), clean=CleanSettings(action="repair"))
    began = time.process_time()
    good = run(scene, "given", settings, folder / "good", folder / "1")
    seconds = time.process_time() - began
    spoilt = run(scene, "given", settings, folder / "bad", folder / "2")
    flagged = {row.name for row in spoilt.flagged}
    repaired = [overlap(read_mask(mask_path(folder / "2", name)), truth[name]) for name in bad]
    names = sorted(truth)
    three = [names[len(names) * part // 6] for part in (1, 3, 5)]
    return Row(
        scene=scene,
        photos=len(truth),
        agreement=min(row.agreement or 0.0 for row in good.rows),
        false_alarms=len(good.flagged),
        spoilt=len(bad),
        found=len(flagged & set(bad)),
        wrongly=len(flagged - set(bad)),
        spoilt_iou=float(np.mean([overlap(bad[name], truth[name]) for name in bad])),
        repaired_iou=float(np.mean(repaired)),
        grabcut_three=grab_cut(scene, truth, three, folder / "three"),
        grabcut_all=grab_cut(scene, truth, names, folder / "all"),
        outlined=outlined(scene, truth, folder / "outlined"),
        seconds=seconds,
    )


def grab_cut(scene: str, truth: dict[str, np.ndarray], names: list[str], folder: Path) -> float:
    """Mean IoU over all photos from boxes in some."""
    folder.mkdir()
    boxes = {}
    for name in names:
        rows, columns = np.nonzero(truth[name])
        low, high = np.array([columns.min(), rows.min()]) - 4, np.array([columns.max(), rows.max()]) + 5
        boxes[name] = {"box": [*map(int, low), *map(int, high)]}
    (folder / "masks.json").write_text(json.dumps({"cutouts": boxes}), encoding="utf-8")
    run(scene, "grabcut", MaskSettings(drawn=DrawnSettings(file="masks.json")), folder, folder / "out")
    values = []
    for name, mask in truth.items():
        found = read_mask(mask_path(folder / "out", name))
        values.append(overlap(nearest_resize(found, mask.shape[1], mask.shape[0]), mask))
    return float(np.mean(values))


def outlined(scene: str, truth: dict[str, np.ndarray], folder: Path) -> float:
    """Mean IoU over the photos without marks, from the outlines of eight others."""
    import cv2

    folder.mkdir()
    names = sorted(truth)
    cutouts = {}
    for part in range(8):
        name = names[(2 * part + 1) * len(names) // 16]
        filled = in_form(truth[name], "filled").astype(np.uint8)
        found, _ = cv2.findContours(filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_TC89_L1)
        corners = max(found, key=cv2.contourArea)[:, 0] + 0.5
        cutouts[name] = {"outline": corners.tolist()}
    (folder / "masks.json").write_text(json.dumps({"cutouts": cutouts}), encoding="utf-8")
    settings = MaskSettings(drawn=DrawnSettings(file="masks.json"), clean=CleanSettings(action="flag"))
    run(scene, "grabcut", settings, folder, folder / "out")
    others = [name for name in names if name not in cutouts and mask_path(folder / "out", name).is_file()]
    return float(np.mean([overlap(read_mask(mask_path(folder / "out", name)), truth[name]) for name in others]))


def clock_door() -> dict[str, float]:
    """Pixels between drawn and carried corners in photos that a fit did not see: from every two of four, from one."""
    import itertools

    from rtgs.prepare.masks.drawn import read_drawing
    from rtgs.prepare.masks.plane import fit_pane
    from rtgs.scenes.undistort import project

    shared = Path(os.environ.get("RTGS_SHARED", "../shared"))
    capture = read_capture(SceneSettings(path=str(shared / "data/glass_clock")))
    views = {view.name: view for view in capture.views}
    size = {name: np.array([lens.width, lens.height]) for name, view in views.items() if (lens := view.lens)}
    marks = read_drawing(CLOCK_MARKS, views).panes["door"]
    drawn = {name: corners / size[name] for name, corners in marks.items()}
    errors: dict[int, list[float]] = {1: [], 2: []}
    for count in errors:
        for names in itertools.combinations(drawn, count):
            pane = fit_pane("door", {name: drawn[name] for name in names}, views, capture.points, DrawnSettings())
            for name in drawn.keys() - set(names):
                view = views[name]
                assert view.lens is not None
                carried = project(view.lens, pane.corners @ view.rotation.T + view.translation)
                errors[count].append(float(np.linalg.norm(carried - marks[name], axis=1).mean()))
    return {
        "two_photos_mean": float(np.mean(errors[2])),
        "two_photos_worst": max(errors[2]),
        "one_photo_mean": float(np.mean(errors[1])),
        "one_photo_worst": max(errors[1]),
    }


@dataclass(frozen=True)
class NetworkTimes:
    """What a network takes for a photo of 800 x 600, with random weights; medians."""

    seconds: float
    cpu_seconds: float  # of all threads
    load_seconds: float  # CPU, once
    memory_mb: float  # peak of the process
    imports_mb: float  # of it, before the network was loaded


def time_network(part: str, folder: Path, photos: int) -> NetworkTimes:
    """The detector for one phrase, or the segmenter for one box."""
    from rtgs.prepare.masks.detect import Box, Detector, PromptTokenizer
    from rtgs.prepare.masks.segment import Segmenter
    from rtgs.prepare.masks.settings import DetectorSettings, SegmenterSettings
    from rtgs.prepare.onnx import Network

    before, began = peak_memory_mb(), time.process_time()
    photo = np.random.default_rng(0).random((600, 800, 3), dtype=np.float32)
    if part == "detector":
        model, tokens = folder / "grounding_dino/model.onnx", folder / "grounding_dino/tokenizer.json"
        detect = Detector(Network(model), PromptTokenizer(tokens), DetectorSettings(prompt="glass"))
    else:
        encoder, decoder = Network(folder / "sam2/encoder.onnx"), Network(folder / "sam2/decoder.onnx")
        segment = Segmenter(encoder, decoder, SegmenterSettings(min_score=0.0))
        boxes = [Box(100.0, 100.0, 500.0, 400.0, 1.0, "glass")]
    loaded = time.process_time() - began
    times = []
    for _ in range(photos + 1):  # the first one fills caches
        wall, cpu = time.perf_counter(), time.process_time()
        detect(photo) if part == "detector" else segment(photo, boxes)
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = np.median(times[1:], axis=0).tolist()
    return NetworkTimes(wall, cpu, loaded, peak_memory_mb(), before)


def time_networks(folder: Path, photos: int, parts: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Each network in a process of its own, with its own memory; made before where its file is not there."""
    figures = {}
    for part in parts:
        words = [sys.executable, "-m", "benchmarks.quality.masks", "--part", part, "--photos", str(photos)]
        if not (folder / ("grounding_dino/model.onnx" if part == "detector" else "sam2/decoder.onnx")).is_file():
            subprocess.run([*words, "--make", str(folder)], check=True)
        done = subprocess.run([*words, "--one", str(folder)], check=True, stdout=subprocess.PIPE)
        figures[part] = json.loads(done.stdout.splitlines()[-1])
    return figures


def make_networks(folder: Path, part: str) -> None:
    """Export a real architecture with random weights."""
    import transformers
    from tokenizers import Tokenizer, models, pre_tokenizers, processors

    from rtgs.prepare.masks.onnx_export import export_grounding_dino, export_sam2

    if part == "segmenter":
        model = transformers.Sam2Model(transformers.Sam2Config())
        export_sam2(model, folder / "sam2/encoder.onnx", folder / "sam2/decoder.onnx")
        return
    words = {f"[unused{index}]": index for index in range(1013)}
    ids = {"[PAD]": 0, "[UNK]": 100, "[CLS]": 101, "[SEP]": 102, ".": 1012, "glass": 500}
    words = {word: index for word, index in words.items() if index not in ids.values()} | ids
    tokenizer = Tokenizer(models.WordPiece(words, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    ends = [("[CLS]", 101), ("[SEP]", 102)]
    tokenizer.post_processor = processors.TemplateProcessing(single="[CLS] $A [SEP]", special_tokens=ends)
    (folder / "grounding_dino").mkdir(parents=True, exist_ok=True)
    tokenizer.save(str(folder / "grounding_dino/tokenizer.json"))
    dino = transformers.GroundingDinoForObjectDetection(transformers.GroundingDinoConfig())
    export_grounding_dino(dino, folder / "grounding_dino/model.onnx")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE")
    parser.add_argument("--spoilt", type=float, default=0.15, help="share of the masks (default: %(default)s)")
    parser.add_argument("--networks", type=Path, help="time the networks, whose files lie here or are made here")
    parser.add_argument("--part", choices=PARTS, help="of the networks (default: both, one after the other)")
    parser.add_argument("--clock", action="store_true", help="carry the door of the real capture glass_clock")
    parser.add_argument("--photos", type=int, default=5, help="timed, median (default: %(default)s)")
    parser.add_argument("--make", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.make is not None:
        make_networks(options.make, options.part)
        return
    if options.one is not None:
        print(json.dumps(asdict(time_network(options.part, options.one, options.photos))))
        return
    if options.networks is not None:
        parts = (options.part,) if options.part else PARTS
        print(json.dumps({"machine": machine(), "networks": time_networks(options.networks, options.photos, parts)}))
        return
    if options.clock:
        print(json.dumps({"clock_door_pixels": clock_door()}))
        return
    rows = []
    for scene in options.scenes:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measure(scene, options.spoilt, Path(folder)))
        row = rows[-1]
        print(
            f"{row.scene}: true masks agree with their hull by {row.agreement:.2f} at least, {row.false_alarms} of "
            f"{row.photos} flagged; {row.found} of {row.spoilt} spoilt ones found, {row.wrongly} good ones flagged, "
            f"IoU {row.spoilt_iou:.2f} -> {row.repaired_iou:.2f}; by hand: GrabCut {row.grabcut_three:.2f} from three "
            f"boxes, {row.grabcut_all:.2f} from all, {row.outlined:.2f} from eight outlines; {row.seconds:.1f} s CPU",
            flush=True,
        )
    print(json.dumps({"machine": machine(), "rows": [asdict(row) for row in rows]}))


if __name__ == "__main__":
    main()
