"""Frames out of a video: sharp ones, evenly spaced in motion; and videos nothing can be learnt from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.poses.video import Candidate, look_at_frames, select_frames, shift_between, write_frames
from rtgs.prepare.progress import Ticker
from rtgs.prepare.settings import VideoSettings
from tests.prepare.room import photo, walk

av = pytest.importorskip("av")
SETTINGS = VideoSettings(min_frames=4, candidates_per_second=30)


def write_video(path: Path, frames: list[np.ndarray], rate: int = 30) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        for pixels in frames:
            for packet in stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def blurred(pixels: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(pixels, (0, 0), 4)


def test_frames_are_sharp_and_evenly_spaced_in_motion(tmp_path):
    """Five frames stand still, then the camera walks; every third frame of the walk is blurred."""
    poses = walk(24)
    frames = [photo(poses[0])] * 5 + [photo(pose) for pose in poses]
    smeared = set(range(6, len(frames), 3))
    path = write_video(tmp_path / "walk.mp4", [blurred(f) if i in smeared else f for i, f in enumerate(frames)])
    seen = look_at_frames(path, SETTINGS, lambda *_: None)
    assert len(seen) == len(frames)
    chosen = select_frames(seen, replace(SETTINGS, max_frames=9, shift=0.01))
    numbers = [candidate.index for candidate in chosen]
    assert 7 <= len(chosen) <= 9
    assert not smeared & set(numbers)
    assert sum(number < 5 for number in numbers) <= 1, "standing still gives one frame"
    files = write_frames(path, chosen, tmp_path / "frames", replace(SETTINGS, max_side=160), lambda _: None)
    assert [int(file.name.split("_")[1]) for file in files] == numbers
    assert Image.open(files[0]).size == (160, 120)
    small = np.stack([cv2.resize(frame, (160, 120), interpolation=cv2.INTER_AREA) for frame in frames]).astype(int)
    nearest = np.abs(small - np.asarray(Image.open(files[-1]))).mean(axis=(1, 2, 3)).argmin()
    assert nearest == numbers[-1], "it is that very frame"


def test_a_video_without_motion_is_refused(tmp_path):
    path = write_video(tmp_path / "still.mp4", [photo(walk(1)[0])] * 8)
    with pytest.raises(PrepareError, match=r"the video hardly moves: 8 frames shift by 0\.0.*walk around the scene"):
        select_frames(look_at_frames(path, SETTINGS, lambda *_: None), SETTINGS)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "cannot be read"),
        (b"no video at all" * 50, "cannot be read"),
        (None, "does not exist: correct scene.path"),
    ],
)
def test_what_is_no_video_is_a_message(tmp_path, content, message):
    path = tmp_path / "clip.mp4"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(PrepareError, match=message):
        look_at_frames(path, SETTINGS, lambda *_: None)


def test_without_the_decoder_the_message_names_it(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(PrepareError, match=r"pip install 'rtgs\[prepare\]'"):
        look_at_frames(tmp_path / "clip.mp4", SETTINGS, lambda *_: None)


def test_a_cut_counts_as_large_motion_and_a_blank_wall_as_none():
    grey = np.asarray(Image.fromarray(photo(walk(1)[0])).convert("L"))
    other = np.asarray(Image.fromarray(photo(walk(1)[0], seed=3)).convert("L"))
    assert shift_between(grey, np.roll(grey, 8, axis=1)) == pytest.approx(8 / 320, abs=0.003)
    assert shift_between(grey, other) > 0.02
    assert shift_between(np.full_like(grey, 90), grey) == 0


def test_few_frames_are_all_taken_and_limits_hold():
    even = [Candidate(i, i / 30, 1.0, 0.1 if i else 0.0) for i in range(300)]
    assert len(select_frames(even, VideoSettings(max_frames=40))) == 40
    assert len(select_frames(even[:12], VideoSettings())) == 12
    slow = [replace(candidate, motion=0.001) for candidate in even]
    assert len(select_frames(slow, VideoSettings())) == 20


def test_progress_tells_the_rest(monkeypatch):
    from rtgs.prepare import progress

    times = iter([0.0, 10.0, 11.0, 20.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(times))
    said: list[str] = []
    ticker = Ticker(said.append, "matching pairs", 100)
    for done in (10, 11, 20):
        ticker(done)
    assert said == ["matching pairs: 10/100, about 1:30 left", "matching pairs: 20/100, about 1:20 left"]
