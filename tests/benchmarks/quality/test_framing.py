"""The tool that judges viewpoints before they are rendered, on a scene whose answer is known."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mitsuba", reason="path tracing needs the extra 'synthetic'")

from benchmarks.quality import framing
from rtgs.scenes.synthetic import variants

BALL_IN_A_ROOM = """
title = "A ball in a room"
[viewpoints]
count = COUNT
radius = [2.0, 2.0]
elevation = [10.0, 10.0]
rings = 1
arc = ARC
jitter = 0.0
field_of_view = 40.0
WIDE
[[shape]]
name = "room"
kind = "box"
size = [3.0, 3.0, 3.0]
inward = true
[[shape]]
name = "ball"
kind = "sphere"
size = [0.3, 0.0, 0.0]
"""
WIDE = "wide_every = 2\nwide_elevation = [10.0, 10.0]\nwide_field_of_view = 120.0"


@pytest.fixture(autouse=True)
def small_and_scalar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variants, "find_llvm", lambda: None)


def shares(run, tmp_path: Path, arc: str, wide: str, count: int = 9) -> float:
    file = tmp_path / f"ball_{arc}.toml"
    file.write_text(BALL_IN_A_ROOM.replace("ARC", arc).replace("WIDE", wide).replace("COUNT", str(count)))
    return run(framing, str(file), "--width", "16", "--height", "12")["below_three"][file.stem]


def test_views_close_together_show_what_a_test_view_shows(run, tmp_path):
    assert shares(run, tmp_path, "9.0", "") < 0.2


def test_a_wide_lens_shows_what_far_views_do_not(run, tmp_path):
    plain = shares(run, tmp_path, "360.0", "", 16)
    assert plain > 0.4
    assert shares(run, tmp_path, "360.0", WIDE, 16) < plain / 2
