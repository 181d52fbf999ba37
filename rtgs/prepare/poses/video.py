"""Frames out of a video: evenly spaced in motion, not in time, and of each stretch the sharpest (PyAV decodes)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.settings import VideoSettings
from rtgs.scenes.images import refuse_pixels

_LOOK_SIDE = 320  # pixels; long side at which motion and sharpness are measured
_CORNERS = 200
_FEW_CORNERS = 12
_UNCERTAIN = 0.02  # share of the frames that a header counts which a whole file may lack: edits cut them away
_UNCERTAIN_RATE = 0.1  # likewise where only the duration is known, which may be that of the sound
_LOST = 0.5  # long sides; motion between candidates whose corners cannot be followed: a cut, or a fast pan


@dataclass(frozen=True)
class Candidate:
    """A frame that was looked at."""

    index: int  # number of the frame in decoding order
    seconds: float
    sharpness: float  # variance of the Laplacian of the shrunk grey picture, grey levels squared
    motion: float  # since the candidate before, median of followed corners, in long sides


def select_frames(candidates: list[Candidate], settings: VideoSettings) -> list[Candidate]:
    """The sharpest candidate of each of n stretches of equal motion; n follows from ``shift`` and the limits.

    Raises:
        PrepareError: the whole motion is less than ``min_motion``.
    """
    total = sum(candidate.motion for candidate in candidates)
    if total < settings.min_motion:
        raise PrepareError(
            f"the video hardly moves: {len(candidates)} frames shift by {total:.3f} of the picture's long side in all, "
            f"at least {settings.min_motion:g} is needed; walk around the scene instead of turning or standing still, "
            "or lower sfm.video.min_motion"
        )
    count = int(np.clip(round(total / settings.shift) + 1, settings.min_frames, settings.max_frames))
    if count >= len(candidates):
        return list(candidates)
    travelled = np.cumsum([candidate.motion for candidate in candidates])
    stretch = np.minimum((travelled / travelled[-1] * count).astype(int), count - 1)
    best: dict[int, Candidate] = {}
    for candidate, part in zip(candidates, stretch):
        if part not in best or candidate.sharpness > best[part].sharpness:
            best[int(part)] = candidate
    return [best[part] for part in sorted(best)]


def look_at_frames(
    path: Path,
    settings: VideoSettings,
    advance: Callable[[int, int], None],
    tell: Callable[[str], None] = lambda _: None,
) -> list[Candidate]:
    """Decode the video once, small, and measure its frames. ``advance`` gets (frames seen, frames there are or 0).

    A video that breaks off gives the frames before the break; ``tell`` gets a sentence that says so.

    Raises:
        PrepareError: no PyAV, no video, no frame in it, or frames of several sizes.
        CaptureError: frames of more pixels than any photo has.
    """
    candidates: list[Candidate] = []
    before: np.ndarray | None = None
    with _opened(path) as stream:
        rate = float(stream.average_rate or 0) or 30.0
        total = int(stream.frames or 0)
        every = max(1, round(rate / settings.candidates_per_second))
        for index, frame in enumerate(_decoded(stream, path, tell)):
            if index % every:
                continue
            grey = _small_grey(frame)
            motion = 0.0 if before is None else shift_between(before, grey)
            seconds = float(frame.time) if frame.time is not None else index / rate
            candidates.append(Candidate(index, seconds, sharpness(grey), motion))
            before = grey
            advance(index + 1, total)
    if not candidates:
        raise PrepareError(f"video {path} holds no frame that can be decoded: export it again as MP4 (H.264)")
    return candidates


def write_frames(
    path: Path, chosen: list[Candidate], target: Path, settings: VideoSettings, advance: Callable[[int], None]
) -> list[Path]:
    """Decode again and write the chosen frames, upright, as JPEG named by number and time."""
    wanted = {candidate.index: candidate for candidate in chosen}
    written: list[Path] = []
    target.mkdir(parents=True, exist_ok=True)
    with _opened(path) as stream:
        for index, frame in enumerate(_decoded(stream, path)):
            if index not in wanted:
                continue
            place = target / f"frame_{index:06d}_{wanted[index].seconds:07.2f}s.jpg"
            _save(frame, place, settings)
            written.append(place)
            advance(len(written))
            if len(written) == len(wanted):
                break
    return written


def _save(frame: Any, place: Path, settings: VideoSettings) -> None:
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), _quarter_turns(frame))))
    if settings.max_side is not None and max(picture.size) > settings.max_side:
        scale = settings.max_side / max(picture.size)
        size = (round(picture.width * scale), round(picture.height * scale))
        picture = picture.resize(size, Image.Resampling.LANCZOS)
    picture.save(place, "JPEG", quality=settings.jpeg_quality)


def _quarter_turns(frame: Any) -> int:
    """Counter-clockwise quarter turns that set the picture upright (the display matrix, as PyAV gives it)."""
    return round(getattr(frame, "rotation", 0) / 90) % 4


def sharpness(grey: np.ndarray) -> float:
    """Variance of the Laplacian of a grey picture (H, W) uint8: less where a moving camera smeared it."""
    import cv2

    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def shift_between(before: np.ndarray, after: np.ndarray) -> float:
    """Median length of the paths of corners from one grey picture to the next, in long sides (Lucas-Kanade)."""
    import cv2

    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 7)
    if corners is None or len(corners) < _FEW_CORNERS:
        return 0.0
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty_like(corners), winSize=(21, 21))
    followed = found.reshape(-1) == 1
    if followed.sum() < _FEW_CORNERS:
        return _LOST
    path = np.linalg.norm((moved - corners).reshape(-1, 2)[followed], axis=1)
    return min(float(np.median(path)) / max(before.shape), _LOST)


def _small_grey(frame: Any) -> np.ndarray:
    scale = min(1.0, _LOOK_SIDE / max(frame.width, frame.height))
    width, height = max(2, int(frame.width * scale) // 2 * 2), max(2, int(frame.height * scale) // 2 * 2)
    return np.ascontiguousarray(frame.reformat(width, height, format="gray").to_ndarray())


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The first video stream of a file.

    Raises:
        PrepareError: no PyAV, an unreadable file, no video stream.
    """
    try:
        import av
        from av.error import FFmpegError
    except ImportError as error:
        raise PrepareError(
            f"{path.name} is a video, and reading it needs the package av: pip install -e '.[prepare]' in the clone of "
            "rtgs, or cut it into photos yourself (ffmpeg -i video.mp4 -vf fps=2 photos/%04d.jpg)"
        ) from error
    if not path.is_file():
        raise PrepareError(f"video {path} does not exist: correct scene.path")
    try:
        container = av.open(str(path))
    except (FFmpegError, OSError, ValueError) as error:
        raise PrepareError(
            f"video {path} cannot be read ({error}): copy it again or export it as MP4 (H.264)"
        ) from error
    with container:
        if not container.streams.video:
            raise PrepareError(f"{path} holds no video stream: correct scene.path")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise PrepareError(f"video {path}: no decoder here knows its pictures; export it again as MP4 (H.264)")
        refuse_pixels((stream.width, stream.height), path)
        stream.thread_type = "AUTO"
        yield stream


def _decoded(stream: Any, path: Path, tell: Callable[[str], None] = lambda _: None) -> Iterator[Any]:
    """Frames in order, all of one size; a video that breaks off gives those before the break, and tells."""
    from av.error import FFmpegError

    count, first = 0, (0, 0)
    try:
        for frame in stream.container.decode(stream):
            size = (frame.width, frame.height)
            first = first if count else size
            if size != first:
                raise PrepareError(
                    f"video {path}: frame {count} has {size[0]}x{size[1]} pixels, those before it "
                    f"{first[0]}x{first[1]}; export it again with one size, or cut it there"
                )
            count += 1
            yield frame
    except FFmpegError as error:
        if not count:
            raise PrepareError(f"video {path} cannot be decoded ({error}): export it again as MP4 (H.264)") from error
        tell(f"video {path} breaks off after {count} frames ({error}): what follows is not used")
        return
    promised = _promised_frames(stream)
    if count and count < promised:
        tell(
            f"video {path} breaks off after {count} of at least {promised} frames: what follows is not used; copy it "
            "again if it is longer"
        )


def _promised_frames(stream: Any) -> int:
    """Fewest frames that a whole file has by its own header, with room for what cuts and uneven rates leave out; 0: it
    does not say."""
    if stream.frames:
        return round(stream.frames * (1 - _UNCERTAIN)) - 1
    seconds = float(stream.duration * stream.time_base) if stream.duration else (stream.container.duration or 0) / 1e6
    return round(seconds * float(stream.average_rate or 0) * (1 - _UNCERTAIN_RATE)) - 1
