"""What a capture is, looked at once for everything that planning decides about it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from pipelines.steps.normals import photo_settings
from rtgs.prepare.settings import SfmSettings
from rtgs.prepare.source import Source, find_source
from rtgs.scenes.capture import Capture
from rtgs.scenes.digest import capture_digest
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.settings import SceneSettings


@dataclass(frozen=True)
class Inspection:
    """A capture as its files describe it. Opens no photo; hashes files when a digest is asked for, once.

    Attributes:
        scene: the settings it was read with.
        source: where the scene comes from, and whether it has poses.
        capture: views, poses and points; None: a source without poses.
    """

    scene: SceneSettings
    source: Source
    capture: Capture | None

    @property
    def folder(self) -> Path:
        """The folder of the capture, of the photos, or of the video."""
        return self.source.path if self.source.path.is_dir() else self.source.path.parent

    @cached_property
    def digest(self) -> str:
        """Digest of every file that an import reads (:func:`rtgs.scenes.digest.capture_digest`).

        Raises:
            CaptureError: files are missing.
        """
        return capture_digest(self.scene, self._read)

    @cached_property
    def photo_digest(self) -> str:
        """Digest of photos and poses alone, of all of them that ``max_views`` keeps.

        Raises:
            CaptureError: files are missing.
        """
        views = tuple(replace(view, mask=None, normal=None) for view in self._read.views)
        return capture_digest(photo_settings(self.scene), replace(self._read, views=views))

    @property
    def _read(self) -> Capture:
        assert self.capture is not None, "a source without poses has no digest of a capture"
        return self.capture

    @property
    def mask_files(self) -> tuple[Path, ...]:
        """Masks that the capture brings."""
        from rtgs.scenes.images import MASK_SUFFIXES

        if self.capture is not None:
            return tuple(view.mask for view in self.capture.views if view.mask is not None)
        folder = self.source.path / self.scene.masks_dir
        if not self.scene.masks_dir or not folder.is_dir():
            return ()
        return tuple(sorted(path for path in folder.rglob("*") if path.suffix in MASK_SUFFIXES))

    @property
    def given_masks(self) -> str:
        """In words, where the capture brings masks; empty: it brings none."""
        if self.capture is None:
            there = bool(self.scene.masks_dir) and (self.folder / self.scene.masks_dir).is_dir()
            return f"masks are given ({self.scene.masks_dir}/)" if there else ""
        given = len(self.mask_files)
        return f"masks are given ({given} of {len(self.capture.views)} photos)" if given else ""

    @property
    def given_normals(self) -> str:
        """In words, where the capture brings normal maps; empty: it brings none."""
        if self.capture is None:
            there = bool(self.scene.normals_dir) and (self.source.path / self.scene.normals_dir).is_dir()
            return f"normal maps are given ({self.scene.normals_dir}/)" if there else ""
        given = sum(view.normal is not None for view in self.capture.views)
        return f"normal maps are given ({given} of {len(self.capture.views)} photos)" if given else ""


def inspect(scene: SceneSettings, sfm: SfmSettings) -> Inspection:
    """Look at the capture of a scene.

    Raises:
        CaptureError: nothing there that could be a capture, or one that cannot be read.
        PrepareError: it has no poses and none may or can be looked for.
    """
    source = find_source(scene, sfm)
    return Inspection(scene, source, read_capture(scene) if source.has_poses else None)


class Inspections:
    """The captures of the jobs of a sweep, each looked at once for jobs that agree in the settings of scene and sfm.

    Files are taken not to change while it lives: make one for making a plan, and let it go with the plan.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[SceneSettings, SfmSettings], Inspection] = {}

    def of(self, scene: SceneSettings, sfm: SfmSettings) -> Inspection:
        """The inspection of these settings.

        Raises:
            CaptureError, PrepareError: as :func:`inspect`.
        """
        key = (scene, sfm)
        if key not in self._known:
            self._known[key] = inspect(scene, sfm)
        return self._known[key]
