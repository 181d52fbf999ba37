"""Training and test views."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rtgs.scenes.capture import Capture, CaptureError
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.splits import Split, choose_split, every_nth, hold_out, read_split_file

from .captures import ColmapCapture

NAMES = [f"photo_{index:02d}.png" for index in range(10)]


def split_file(folder, content) -> Path:
    path = folder / "split.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_every_eighth_in_name_order_is_test():
    split = every_nth(NAMES, 8)
    assert split.test == ("photo_00.png", "photo_08.png")
    assert set(split.train) | set(split.test) == set(NAMES)
    assert not set(split.train) & set(split.test)
    assert every_nth(NAMES, 0).test == ()
    assert every_nth(NAMES, 1).train == ()


@pytest.mark.parametrize(
    ("count", "every", "held"),
    [
        (42, 12, [5, 15, 26, 36]),  # four of 42, each in the middle of its quarter
        (20, 12, [5, 15]),  # never only one
        (300, 12, list(range(12, 300, 25))),  # never more than twelve
        (8, 1, [1, 3, 5, 7]),  # half of them stay
        (7, 12, []),  # none can be spared
        (42, 0, []),
    ],
)
def test_held_out_views_are_spread_over_the_training_views(count: int, every: int, held: list[int]):
    names = tuple(f"{index:03d}" for index in range(count))
    split = hold_out(Split(names, ("test",), "a rule"), every)
    assert split.held == tuple(names[index] for index in held)
    assert split.train == tuple(name for name in names if name not in split.held)
    assert (split.test, split.rule) == (("test",), "a rule")


@pytest.mark.parametrize("form", ["{}", "images/{}", "./images/{}", "stem"])
def test_names_match_with_folder_or_without_suffix(tmp_path, form):
    def named(name):
        return name.removesuffix(".png") if form == "stem" else form.format(name)

    path = split_file(tmp_path, {"train": [named(n) for n in NAMES[:4]], "test": [named(NAMES[7])]})
    split = read_split_file(path, NAMES)
    assert split.train == tuple(NAMES[:4])
    assert split.test == (NAMES[7],)


def test_without_train_list_all_others_train(tmp_path):
    split = read_split_file(split_file(tmp_path, {"test": NAMES[2:4]}), NAMES)
    assert split.train == tuple(NAMES[:2] + NAMES[4:])


def test_equal_names_in_two_folders_are_told_apart(tmp_path):
    known = ["left/a.png", "right/a.png", "right/b.png"]
    assert read_split_file(split_file(tmp_path, {"test": ["left/a.png"]}), known).test == ("left/a.png",)
    with pytest.raises(CaptureError, match=r"a.png \(fits left/a.png, right/a.png\)"):
        read_split_file(split_file(tmp_path, {"test": ["a.png"]}), known)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"train": [], "test": ["nobody.png"]},
            "names 1 images the capture does not have: nobody.png; names look like",
        ),
        ({"train": NAMES[:3], "test": NAMES[2:4]}, "in both train and test: photo_02.png"),
        ({"test": "photo_00.png"}, "must hold"),
        ({"train": [1], "test": []}, "train must be a list of image names"),
        ({"train": NAMES}, "must hold"),
        ("{broken", "not valid JSON"),
        ("[]", "must hold"),
    ],
)
def test_bad_split_files(tmp_path, content, message):
    with pytest.raises(CaptureError, match=message):
        read_split_file(split_file(tmp_path, content), NAMES)


def test_missing_split_file(tmp_path):
    with pytest.raises(CaptureError, match=r"split file .*split.json does not exist: correct scene.split_file"):
        read_split_file(tmp_path / "split.json", NAMES)


def test_split_file_goes_before_the_formats_own_and_that_before_every_nth(tmp_path):
    split_file(tmp_path, {"test": NAMES[5:6]})
    own = dict.fromkeys(NAMES, "train") | {NAMES[1]: "test", NAMES[2]: "unused"}
    root = ColmapCapture(tmp_path).write()
    capture = Capture("transforms", root, (), None, (), own)
    assert choose_split(capture, NAMES, SceneSettings()).test == (NAMES[1],)
    assert NAMES[2] not in choose_split(capture, NAMES, SceneSettings()).train
    scene = load_scene(SceneSettings(path=str(root), split_file="split.json"))
    assert [view.name for view in scene.test] == [NAMES[5]]
    assert "split file split.json" in scene.source


def test_max_views_thins_evenly_before_splitting(tmp_path):
    root = ColmapCapture(tmp_path).write()
    scene = load_scene(SceneSettings(path=str(root), max_views=4))
    assert [view.name for view in scene.test] == ["photo_00.png"]
    assert [view.name for view in scene.train] == ["photo_03.png", "photo_06.png", "photo_09.png"]
