"""Names of strangers as paths, and as file names of which no two are alike."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtgs.core.errors import RtgsError
from rtgs.core.names import escaped_stem, path_inside, plain_stem, refuse_name, stored_file, unique_stems

HOSTILE = {
    "../x.jpg": "leaves its folder",
    "a/../../x.jpg": "leaves its folder",
    "a\\..\\..\\x.jpg": "leaves its folder",
    "a/..": "leaves its folder",
    "/etc/passwd": "is absolute",
    "//host/x.jpg": "is absolute",
    "\\\\host\\x.jpg": "is absolute",
    "C:\\x.jpg": "is absolute",
    "c:x.jpg": "is absolute",
    "": "names no file",
    ".": "names no file",
    "./": "names no file",
    "a\0.jpg": "control character",
    "a\n.jpg": "control character",
    "a" * 250: "too long",
    "/".join(["ab"] * 400): "too long",
    "ä" * 150: "too long",
    "a\udc80.jpg": "no Unicode text",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_names_that_lead_elsewhere_are_refused(name):
    with pytest.raises(RtgsError, match=HOSTILE[name]) as error:
        path_inside(Path("capture"), name, "model.bin")
    assert str(error.value).startswith("model.bin: the name ")
    assert len(str(error.value)) < 300


@pytest.mark.parametrize(
    "name", ["a.jpg", "left/0001.jpg", "./a.jpg", "..a.jpg", "a..b/c.jpg", "ab:c.jpg", "Türe 1.jpg"]
)
def test_ordinary_names_are_kept(name):
    assert path_inside(Path("capture"), name) == Path("capture") / name


@given(st.text(max_size=40) | st.lists(st.sampled_from(["..", ".", "a", "", "C:", "\\", "b.jpg"])).map("/".join))
def test_what_is_accepted_lies_inside(name):
    try:
        path = path_inside(Path("/capture/images"), name)
    except RtgsError:
        return
    resolved = os.path.normpath(path)
    assert resolved.startswith("/capture/images/")


def _allowed(name: str) -> bool:
    try:
        refuse_name(name)
    except RtgsError:
        return False
    return True


PARTS = st.text("abAB_.~é/-% \\", min_size=1, max_size=6)
NAMES = st.lists((PARTS | st.text(max_size=8)).filter(_allowed), unique=True, max_size=6)


@given(NAMES)
def test_no_two_names_share_a_stem(names):
    stems = unique_stems(names)
    assert list(stems) == names
    assert len({stem.casefold() for stem in stems.values()}) == len(names)
    assert all(stem and "/" not in stem and "\0" not in stem and len(stem.encode()) <= 200 for stem in stems.values())


@given(NAMES, NAMES)
def test_escaped_stems_depend_on_the_name_alone(first, second):
    both = {escaped_stem(name): name for name in (*first, *second)}
    assert len(both) == len({*first, *second})


@given(names=NAMES)
def test_what_was_written_is_found_again(tmp_path_factory, names):
    folder = tmp_path_factory.mktemp("views")
    for name, stem in unique_stems(names).items():
        (folder / f"{stem}.txt").write_text(name)
    assert [stored_file(folder, name, ".txt").read_text() for name in names] == names


MEETING = [("s/t.jpg", "s_t.jpg"), ("a.jpg", "a.png"), ("A.jpg", "a.jpg"), ("x" * 200, "a.jpg")]


def test_names_that_stay_apart_keep_their_stems():
    names = ["images/000.png", "images/008.png", "IMG 1.JPG"]
    assert list(unique_stems(names).values()) == ["images_000", "images_008", "IMG 1"]
    assert plain_stem("left/0001.jpg") == "left_0001"


@pytest.mark.parametrize("names", MEETING)
def test_names_that_would_meet_are_written_in_full(names):
    stems = unique_stems(names)
    assert len({stem.casefold() for stem in stems.values()}) == 2
    assert stems == {name: escaped_stem(name) for name in names}


def test_long_names_keep_a_digest():
    stems = [escaped_stem("/".join(["long name"] * 90) + ending) for ending in ("a", "b")]
    assert stems[0] != stems[1]
    assert all(len(stem) < 180 for stem in stems)
