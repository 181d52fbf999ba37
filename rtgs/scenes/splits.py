"""Which views are used, and which of them are for training and which for testing (method.md 8.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from rtgs.core.documents import DocumentError, load_json
from rtgs.scenes.capture import Capture, CaptureView, list_some
from rtgs.scenes.settings import CaptureError, SceneSettings


@dataclass(frozen=True)
class Split:
    """Names of the views of each part, in name order."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    rule: str  # how it was decided, for the log and the report
    held: tuple[str, ...] = ()  # neither trained on nor tested on


_LEAST_HELD, _MOST_HELD = 2, 12  # one view has no spread; more cost training views and tell little
_LEAST_TRAIN = 8  # of fewer training views none can be spared


def select_views(capture: Capture, settings: SceneSettings) -> list[CaptureView]:
    """The views in name order, thinned evenly to ``max_views``."""
    views = list(capture.views)
    if settings.max_views is None or settings.max_views >= len(views):
        return views
    chosen = np.unique(np.round(np.linspace(0, len(views) - 1, settings.max_views)).astype(int))
    return [views[index] for index in chosen]


def choose_split(capture: Capture, names: list[str], settings: SceneSettings) -> Split:
    """Divide ``names`` (sorted) by the split file, else the format's own split, else every n-th.

    Raises:
        CaptureError: a split file that is missing, malformed, names unknown images or one image twice.
    """
    if settings.split_file is not None:
        path = capture.root / settings.split_file
        return _restricted(read_split_file(path, [view.name for view in capture.views]), names)
    if capture.split:
        parts = {part: tuple(n for n in names if capture.split.get(n) == part) for part in ("train", "test")}
        return Split(parts["train"], parts["test"], f"the split of the {capture.format} capture")
    return every_nth(names, settings.split_every)


def every_nth(names: list[str], every: int) -> Split:
    """Views whose index in name order is divisible by ``every`` are test views; 0 = none."""
    if every == 0:
        return Split(tuple(names), (), "no test views (split_every=0)")
    test = tuple(names[::every])
    chosen = set(test)
    return Split(
        tuple(n for n in names if n not in chosen), test, f"every {every}th view in name order, from the first"
    )


def hold_out(split: Split, every: int) -> Split:
    """Take about every n-th of the training views out of them, evenly over name order; 0 = none."""
    count = len(split.train)
    if every == 0 or count < _LEAST_TRAIN:
        return split
    held = min(max(round(count / every), _LEAST_HELD), _MOST_HELD, count // 2)
    places = {(2 * k + 1) * count // (2 * held) for k in range(held)}
    return replace(
        split,
        train=tuple(name for place, name in enumerate(split.train) if place not in places),
        held=tuple(name for place, name in enumerate(split.train) if place in places),
    )


def read_split_file(path: Path, known: list[str]) -> Split:
    """Read ``{"train": [...], "test": [...]}``. Names match views exactly, or by path tail, with or without suffix.

    Raises:
        CaptureError: the file is missing or malformed, or names an unknown image, or one image twice.
    """
    if not path.is_file():
        raise CaptureError(f"split file {path} does not exist: correct scene.split_file")
    try:
        content = load_json(path)
    except (OSError, DocumentError) as error:
        raise CaptureError(f"split file {path} is not valid JSON ({error})") from error
    if not isinstance(content, dict) or not _is_name_list(content.get("test", [])) or "test" not in content:
        raise CaptureError(f'split file {path} must hold {{"train": [names], "test": [names]}}')
    if not _is_name_list(content.get("train", [])):
        raise CaptureError(f"split file {path}: train must be a list of image names, got {content['train']!r}")
    matched = {part: _match(path, content.get(part, []), known) for part in ("train", "test")}
    twice = sorted(set(matched["train"]) & set(matched["test"]))
    if twice:
        raise CaptureError(f"split file {path} has images in both train and test: {list_some(twice)}")
    test = set(matched["test"])
    train = matched["train"] if "train" in content else [name for name in known if name not in test]
    return Split(tuple(sorted(set(train))), tuple(sorted(test)), f"split file {path.name}")


def _is_name_list(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(name, str) for name in value)


def _match(path: Path, wanted: list[str], known: list[str]) -> list[str]:
    found, unknown = [], []
    for name in wanted:
        matches = [k for k in known if k == name] or [k for k in known if _same_image(k, name)]
        if len(matches) == 1:
            found.append(matches[0])
        else:
            unknown.append(name if not matches else f"{name} (fits {list_some(matches, 3)})")
    if unknown:
        raise CaptureError(
            f"split file {path} names {len(unknown)} images the capture does not have: {list_some(unknown)}; "
            f"names look like {list_some(known, 3)}"
        )
    return found


def _same_image(known: str, wanted: str) -> bool:
    """True when one path is a tail of the other, suffix included or absent in ``wanted``."""
    for left, right in ((known, wanted), (str(PurePosixPath(known).with_suffix("")), wanted)):
        a, b = PurePosixPath(left).parts, PurePosixPath(right).parts
        count = min(len(a), len(b))
        if count and a[-count:] == b[-count:]:
            return True
    return False


def _restricted(split: Split, names: list[str]) -> Split:
    keep = set(names)
    return Split(tuple(n for n in split.train if n in keep), tuple(n for n in split.test if n in keep), split.rule)
