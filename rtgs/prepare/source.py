"""What lies at ``scene.path``: a capture with poses, photos without, or a video; decided once, with the reason."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.drawn import read_drawing
from rtgs.prepare.masks.settings import MaskSettings
from rtgs.prepare.poses.find import Request, check_count, ignored_folders
from rtgs.prepare.poses.photos import VIDEO_SUFFIXES, find_photo_folder, photo_files, read_photo_set
from rtgs.prepare.settings import SfmSettings
from rtgs.scenes.capture import Finding, list_some
from rtgs.scenes.check import check_capture
from rtgs.scenes.digest import files_digest
from rtgs.scenes.importers.colmap import incomplete_model
from rtgs.scenes.importers.registry import EMBEDDED_PREFIX, capture_root, detect_format, find_format, read_capture
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.splits import select_views


@dataclass(frozen=True)
class Source:
    """Where a scene comes from."""

    path: Path
    """Folder of the capture, or the video file."""
    kind: str
    """``poses``, ``photos`` or ``video``."""
    why: str
    """How that was seen."""

    @property
    def has_poses(self) -> bool:
        """True when the capture can be imported as it is."""
        return self.kind == "poses"


def find_source(scene: SceneSettings, sfm: SfmSettings) -> Source:
    """Look at the path of a scene; opens no photo.

    Raises:
        CaptureError: nothing there that could be a capture, or a damaged model.
        PrepareError: no poses and ``sfm.use=never``, several videos, or no photos under ``sfm.use=always``.
    """
    if scene.path.startswith(EMBEDDED_PREFIX):
        return Source(capture_root(scene), "poses", f"{scene.path} brings its poses")
    path = Path(os.path.expandvars(scene.path)).expanduser()
    if path.is_file():
        return _video(path, sfm)
    root = capture_root(scene)
    found = find_format(root, scene)
    if found is not None and sfm.use != "always":
        return Source(root, "poses", f"poses are given ({found})")
    if found is None and incomplete_model(root, scene.model_dir) and sfm.use != "always":
        detect_format(root, scene)  # raises: a damaged model is not silently made anew
    source = _without_poses(root, scene)
    if sfm.use == "never":
        raise PrepareError(f"{root} has {source.why} and no poses, and sfm.use=never forbids to look for them")
    return source


def _video(path: Path, sfm: SfmSettings) -> Source:
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise PrepareError(
            f"{path} is a file: scene.path names a folder of photos, a capture, or a video "
            f"({', '.join(VIDEO_SUFFIXES)})"
        )
    if sfm.use == "never":
        raise PrepareError(f"{path} is a video without poses, and sfm.use=never forbids to look for them")
    return Source(path, "video", f"the video {path.name}")


def _without_poses(root: Path, scene: SceneSettings) -> Source:
    folder = find_photo_folder(root, scene.images_dir)
    if folder is not None:
        return Source(root, "photos", f"photos in {folder.name if folder != root else root.name}")
    videos = sorted(path for path in root.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES)
    if len(videos) > 1:
        raise PrepareError(f"{root} holds {len(videos)} videos ({list_some(p.name for p in videos)}): name one of them")
    if videos:
        return Source(videos[0], "video", f"the video {videos[0].name}")
    nested = sorted({path.parent.relative_to(root).as_posix() for path in photo_files(root, recursive=True)})
    if nested:
        listed = list_some(nested, 5)
        raise PrepareError(f"no photos in {root} itself, but in {listed}: name the folder with scene.images_dir")
    detect_format(root, scene)
    raise PrepareError(f"{root} holds no photos to look for poses in: correct scene.path, or set sfm.use=auto")


def check_source(scene: SceneSettings, sfm: SfmSettings, masks: MaskSettings | None = None) -> list[Finding]:
    """What is wrong with a capture, with poses or without, errors first; opens every photo. ``masks``: with the file of
    marks that it names, where it is there."""
    try:
        source = find_source(scene, sfm)
    except (CaptureError, PrepareError) as error:
        return [Finding("error", str(error), scene.path)]
    found = check_capture(scene) if source.has_poses else _check_without_poses(source, scene, sfm)
    if masks is None or masks.source == "none" or any(finding.severity == "error" for finding in found):
        return found
    return [*_check_marks(source, scene, masks), *found]


def mark_file(source: Source, masks: MaskSettings) -> Path:
    """Where marks of this capture are, if there are any."""
    return (source.path if source.path.is_dir() else source.path.parent) / masks.drawn.file


def markable_names(source: Source, scene: SceneSettings) -> tuple[str, ...] | None:
    """The photos that a file of marks may name; None of a video, whose frames are chosen later. Opens headers of photos
    without poses.

    Raises:
        CaptureError: the capture cannot be read.
        PrepareError: there are no photos that can be.
    """
    if source.kind == "video":
        return None
    if not source.has_poses:
        return read_photo_set(source.path, scene.images_dir).names
    return tuple(view.name for view in select_views(read_capture(scene), scene))


def _check_marks(source: Source, scene: SceneSettings, masks: MaskSettings) -> list[Finding]:
    """Problems of the file of marks: each would come up hours later, when poses are known."""
    file = mark_file(source, masks)
    if not file.is_file():
        return []
    try:
        marked = read_drawing(file, markable_names(source, scene)).marked
    except (PrepareError, CaptureError) as error:
        return [Finding("error", str(error), str(file))]
    return [Finding("info", f"marks in {len(marked)} photos ({list_some(marked, 4)})", str(file))]


def _check_without_poses(source: Source, scene: SceneSettings, sfm: SfmSettings) -> list[Finding]:
    found = [Finding("info", f"{source.why}, without poses: `rtgs run` looks for them first", str(source.path))]
    if source.kind == "video":
        return found
    try:
        photos = read_photo_set(source.path, scene.images_dir)
        check_count(photos, sfm)
    except PrepareError as error:
        return [Finding("error", str(error), str(source.path)), *found]
    return [*photos.findings, *found]


def source_digest(source: Source, scene: SceneSettings, sfm: SfmSettings) -> str:
    """Digest of every file the search for poses reads: photos or video, and the masks and normal maps beside them.

    Raises:
        CaptureError: a file cannot be read.
    """
    if source.kind == "video":
        return files_digest("video", source.path.parent, [source.path])
    request = Request.of(scene, source.path)
    folder = find_photo_folder(source.path, scene.images_dir) or source.path
    files = set(photo_files(folder, recursive=folder != source.path))
    sides = [source.path / name for name in (scene.masks_dir, scene.normals_dir) if name]
    for side in {*ignored_folders(request, sfm), *sides}:
        files |= {path for path in side.rglob("*") if path.is_file()}
    return files_digest("photos", source.path, files)
