"""Frames out of a video: sharp ones, evenly spaced in motion; and videos nothing can be learnt from."""

from __future__ import annotations

import re
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
from rtgs.scenes.settings import CaptureError
from tests.prepare.room import photo, walk

av = pytest.importorskip("av")
SETTINGS = VideoSettings(min_frames=4, candidates_per_second=30)


def write_video(path: Path, frames: list[np.ndarray], rate: int = 30, **options: str) -> Path:
    with av.open(str(path), "w", options=options) as container:
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


@pytest.mark.parametrize(
    ("codec", "container", "pixels"),
    [
        ("mjpeg", "avi", "yuvj420p"),
        ("ffv1", "matroska", "yuv444p10le"),
        ("ffv1", "matroska", "gray16le"),
        ("png", "nut", "rgba"),
        ("gif", "gif", "rgb8"),
    ],
)
def test_odd_codecs_and_pixels_are_read(tmp_path, codec, container, pixels):
    path, frames = tmp_path / "odd.video", [photo(pose) for pose in walk(6)]
    with av.open(str(path), "w", format=container) as writer:
        stream = writer.add_stream(codec, rate=30)
        stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], pixels
        for each in frames:
            writer.mux(stream.encode(av.VideoFrame.from_ndarray(each, format="rgb24")))
        writer.mux(stream.encode())
    seen = look_at_frames(path, SETTINGS, lambda *_: None)
    assert len(seen) == 6
    (file,) = write_frames(path, seen[3:4], tmp_path / "frames", SETTINGS, lambda _: None)
    found = np.asarray(Image.open(file)).astype(int)
    expected = frames[3].astype(int)
    if pixels == "gray16le":
        found, expected = found.mean(-1), np.asarray(Image.fromarray(frames[3]).convert("L")).astype(int)
    assert np.abs(found - expected).mean() < 20


@pytest.mark.parametrize(("suffix", "options"), [("avi", {}), ("mkv", {}), ("mp4", {"movflags": "faststart"})])
def test_a_video_that_ends_early_gives_its_beginning_and_says_so(tmp_path, suffix: str, options: dict[str, str]):
    """The decoder takes the missing rest for the end; what the file says of itself tells the two apart."""
    whole = write_video(tmp_path / f"whole.{suffix}", [photo(pose) for pose in walk(30)], **options)
    cut = tmp_path / f"cut.{suffix}"
    cut.write_bytes(whole.read_bytes()[: 7 * whole.stat().st_size // 10])
    told: list[str] = []
    assert len(look_at_frames(whole, SETTINGS, lambda *_: None, told.append)) == 30
    assert told == []
    seen = look_at_frames(cut, SETTINGS, lambda *_: None, told.append)
    assert 1 <= len(seen) < 30
    assert len(told) == 1
    assert f"video {cut} breaks off after {len(seen)} of at least" in told[0]


def test_a_truncated_video_gives_its_beginning_and_says_so(tmp_path):
    whole = write_video(tmp_path / "whole.avi", [photo(pose) for pose in walk(12)])
    content = bytearray(whole.read_bytes())
    cut = tmp_path / "cut.avi"
    cut.write_bytes(content[: len(content) // 2])
    told: list[str] = []
    seen = look_at_frames(cut, SETTINGS, lambda *_: None, told.append)
    assert 1 <= len(seen) < 12
    assert f"breaks off after {len(seen)} " in "".join(told)
    cut.write_bytes(content[:200])
    with pytest.raises(PrepareError, match=r"cut\.avi (cannot be read|holds no)"):
        look_at_frames(cut, SETTINGS, lambda *_: None)


def test_a_video_without_frames_is_a_message(tmp_path):
    path = write_video(tmp_path / "clip.mp4", [photo(walk(1)[0])])
    empty = tmp_path / "empty.mkv"
    with av.open(str(path)) as source, av.open(str(empty), "w") as target:
        target.add_stream_from_template(source.streams.video[0])
        target.start_encoding()
    with pytest.raises(PrepareError, match=r"empty\.mkv (holds no frame|cannot be)"):
        look_at_frames(empty, SETTINGS, lambda *_: None)
    with av.open(str(tmp_path / "sound.wav"), "w") as writer:
        stream = writer.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), layout="mono")
        frame.sample_rate = 8000
        writer.mux(stream.encode(frame))
    with pytest.raises(PrepareError, match=r"sound\.wav holds no video stream"):
        look_at_frames(tmp_path / "sound.wav", SETTINGS, lambda *_: None)


def test_a_codec_that_nobody_knows_is_a_message(tmp_path):
    path = write_video(tmp_path / "clip.avi", [photo(walk(1)[0])])
    assert path.read_bytes().count(b"FMP4") >= 1
    path.write_bytes(path.read_bytes().replace(b"FMP4", b"ZZZZ"))
    with pytest.raises(PrepareError, match=r"video .*clip\.avi: no decoder here knows its pictures"):
        look_at_frames(path, SETTINGS, lambda *_: None)


def test_frames_that_change_their_size_are_refused_by_name(tmp_path):
    """OpenCV used to end the step with an assertion of its own."""
    path = tmp_path / "sizes.mjpeg"
    small = photo(walk(1)[0])
    pictures = [small, small, cv2.resize(small, (200, 300)), small]
    path.write_bytes(b"".join(cv2.imencode(".jpg", picture)[1].tobytes() for picture in pictures))
    with pytest.raises(PrepareError, match=r"sizes\.mjpeg: frame 2 has 200x300 pixels, those before it \d+x\d+"):
        look_at_frames(path, SETTINGS, lambda *_: None)


def test_an_enormous_video_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    path = write_video(tmp_path / "clip.mp4", [photo(walk(1)[0])])
    monkeypatch.setattr("rtgs.scenes.images._MOST_PIXELS", 1000)
    with pytest.raises(CaptureError, match=r"clip\.mp4 has \d+x\d+ pixels, at most 1,000 are read"):
        look_at_frames(path, SETTINGS, lambda *_: None)


def test_a_break_is_told(tmp_path):
    path = tmp_path / "clip.nut"
    with av.open(str(path), "w") as writer:
        stream = writer.add_stream("png", rate=30)
        stream.height, stream.width, stream.pix_fmt = *photo(walk(1)[0]).shape[:2], "rgb24"
        for pose in walk(4):
            writer.mux(stream.encode(av.VideoFrame.from_ndarray(photo(pose), format="rgb24")))
        writer.mux(stream.encode())
    content = path.read_bytes()
    third = [found.start() for found in re.finditer(b"\x89PNG", content)][2]
    path.write_bytes(content[:third] + b"gone" + content[third + 4 :])
    told: list[str] = []
    seen = look_at_frames(path, SETTINGS, lambda *_: None, told.append)
    assert len(seen) == 2
    assert len(told) == 1
    assert "clip.nut breaks off after 2 frames" in told[0]


def test_without_the_decoder_the_message_names_it(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(PrepareError, match=r"pip install -e '.\[prepare\]'"):
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
