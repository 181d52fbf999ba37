"""A run's model as one set of Gaussians for programs that know no layers: fitted once, kept in the run's folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.errors import RtgsError
from rtgs.core.files import sha256_of
from rtgs.core.records import read_record, write_json
from rtgs.methods.spec import RASTERIZED
from rtgs.runs.mixture import Judged
from rtgs.runs.record import RunRecord
from rtgs.runs.shown import needed_steps

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.export.bake import BakeSettings, Chosen
    from rtgs.export.formats import Export
    from rtgs.gaussians.ellipsoids import Ellipsoids
    from rtgs.gaussians.primitives import Gaussians
    from rtgs.gaussians.surfels import Surfels
    from rtgs.runs.shown import ShownRun

FOLDER = "exports"
DIRECT = ("base", "transmittance")  # sets that stand where the eye sees them, straight through glass
_TELL_EVERY = 20  # pictures
_MIRRORS = 0.3  # k_s of pixels that mirror
_AGAIN = "delete it, and the same command makes it again"


_WANTED = ("trained", "steps", "most", "clear", "version")
"""Fields of a record that say of which model it is and how it was made."""


@dataclass(frozen=True)
class BakeRecord:
    """How the one set was made, beside it.

    Attributes:
        trained: fingerprints of the run's steps, by name.
        steps: of the fit; 0: the model is one set already, and nothing was fitted.
        most: Gaussians that were asked for at most; 0: not asked for.
        sha256: of the PLY.
        views: pictures of the layered model that it was fitted to.
        psnr: dB against the layered model on held-out cameras; None: nothing was fitted.
        layered_photos: dB of the layered model against the photos of the test views; None: there are none.
        baked_photos: dB of the one set against the same.
        mirrors: dB against the layered model in the pixels that mirror; None: no pixel does, or nothing was fitted.
        version: of the fit (:data:`rtgs.export.bake.BAKE_VERSION`).
        clear: all pictures are as if the walls of glass were not there: a program that draws them adds them.
    """

    trained: dict[str, str]
    steps: int
    most: int
    sha256: str = ""
    views: int = 0
    psnr: float | None = None
    layered_photos: float | None = None
    baked_photos: float | None = None
    clear: bool = False
    version: int = 0
    mirrors: float | None = None

    def fits(self, wanted: BakeRecord) -> bool:
        """Whether it was made of the same model in the same way."""
        return all(getattr(self, name) == getattr(wanted, name) for name in _WANTED)

    def says(self) -> str:
        """One line for people."""
        if self.psnr is None:
            return "the model is one set of Gaussians: nothing is lost"
        what = "layered model without its glass" if self.clear else "layered model"
        text = f"baked: {self.psnr:.2f} dB against the {what} on held-out cameras"
        if self.mirrors is not None:
            text += f", {self.mirrors:.2f} dB where it mirrors (sharp reflections blur: colours hold degree 3 at most)"
        if self.layered_photos is None or self.baked_photos is None:
            return text
        lost = self.layered_photos - self.baked_photos
        return (
            f"{text}; against the test photos {self.baked_photos:.2f} dB, the layered model "
            f"{self.layered_photos:.2f} dB: {lost:.2f} dB lost"
        )


@dataclass(frozen=True)
class ExportedRun:
    """The one set, and the pictures it is compared on."""

    ply: Path
    splats: Surfels | Ellipsoids
    record: BakeRecord
    cameras: tuple[Camera, ...]  # held out
    layered: tuple[Tensor, ...]  # (3, H, W) of the layered model from them

    def export(self, run: ShownRun) -> Export:
        """What goes into a file: the set, with the glass where the set is without it."""
        import torch

        from rtgs.export.formats import Export
        from rtgs.export.glass import glass_object
        from rtgs.light.pictures import mean_frame

        glass = glass_object(run.method) if self.record.clear else None
        frame = mean_frame(torch.stack([camera.rotation for camera in run.cameras]))
        return Export(self.splats, frame, glass)

    def psnr(self, run: ShownRun, splats: Gaussians) -> tuple[float, float]:
        """dB of other splats against this set, and against the layered model; means over the held-out cameras."""
        from rtgs.train.held_out import psnr_of

        against_set, against_layers = 0.0, 0.0
        for camera, target in zip(self.cameras, self.layered):
            image = shown(run, splats, camera)
            against_set += psnr_of(image, shown(run, self.splats, camera).clamp(0, 1))
            against_layers += psnr_of(image, target)
        return against_set / len(self.cameras), against_layers / len(self.cameras)


def shown(run: ShownRun, splats: Gaussians, camera: Camera) -> Tensor:
    """(3, H, W) of splats as common viewers draw them, with the near plane and the background of the run."""
    import torch

    from rtgs.gaussians.ellipsoids import Ellipsoids
    from rtgs.gaussians.surfels import Surfels
    from rtgs.render.splats import render_splats

    assert isinstance(splats, (Surfels, Ellipsoids))
    render = run.method.settings.render
    background = torch.tensor(render.background)
    return render_splats(splats, camera, near=render.near * run.scene.extent, background=background)


def is_one_set(run: ShownRun) -> bool:
    """Whether the run's model is one rasterised set, which a file of splats holds as it is."""
    return RASTERIZED in run.method.spec.has and run.mixture is None


def check_fit(run: ShownRun, steps: int | None, splats: int | None) -> None:
    """What was asked of the fit of one set; None: nothing.

    Raises:
        RtgsError: the run's model is one set, which is written as it is, and something was asked that needs a fit.
    """
    if not is_one_set(run):
        return
    has = len(run.method.sets[0].gaussians)
    as_it_is = f"the model of {run.folder.name} is one set of {has:,} Gaussians and is written as it is"
    if steps is not None:
        raise RtgsError(f"rtgs export: steps={steps}: {as_it_is}, nothing is fitted: leave steps= out")
    if splats is not None and splats < has:
        raise RtgsError(
            f"rtgs export: splats={splats}: {as_it_is}: leave splats= out, or train a smaller model with "
            f"method.density.max_surfels={splats}"
        )


def export_run(run: ShownRun, settings: BakeSettings, out: Path, *, clear: bool = False) -> ExportedRun:
    """The run as one set, in ``out/<run>.ply`` with its record beside it; what lies there and fits is taken.

    Args:
        clear: as if walls of glass were not there, in ``out/<run>-clear.ply``.

    Raises:
        RtgsError: a file there is damaged, or the fit left no Gaussian.
    """
    from rtgs.export.bake import BAKE_VERSION, choose_cameras
    from rtgs.gaussians.ply import write_ply

    name = f"{run.folder.name}-clear" if clear else run.folder.name
    ply, json = out / f"{name}.ply", out / f"{name}.json"
    steps = 0 if is_one_set(run) else settings.steps
    wanted = BakeRecord(_trained(run), steps, settings.most or 0, clear=clear, version=BAKE_VERSION)
    cameras = choose_cameras(run.scene)
    held = [_seen(run, camera, clear) for camera in cameras.held]
    layered = tuple(image for image, _ in held)
    record = read_record(BakeRecord, json, _AGAIN) if json.is_file() and ply.is_file() else None
    if record is None or not record.fits(wanted) or record.sha256 != sha256_of(ply):
        out.mkdir(parents=True, exist_ok=True)
        json.unlink(missing_ok=True)  # until the new file is whole, nothing says what it is
        if is_one_set(run):
            write_ply(ply, _plain(run))
            record = wanted
        else:
            splats, record = _bake(run, settings, cameras, layered, wanted)
            record = replace(record, mirrors=_psnr_of_mirrors(run, splats, cameras.held, held))
            write_ply(ply, splats)
        record = replace(record, sha256=sha256_of(ply))
        write_json(json, asdict(record))
    return ExportedRun(ply, _read(ply), record, cameras.held, layered)


def _read(ply: Path) -> Surfels | Ellipsoids:
    from rtgs.gaussians.ply import read_gaussians

    return read_gaussians(ply, channels=())


def _seen(run: ShownRun, camera: Camera, clear: bool) -> tuple[Tensor, Tensor | None]:
    """(3, H, W) of the layered model, and (H, W) where it mirrors; None: it has no mirrors, or they are not drawn."""
    from rtgs.export.glass import without_glass

    maps = run.maps(camera)
    image = without_glass(run.method, camera, maps) if clear else maps["image"]
    mirrors = None if clear or "specular" not in maps else maps["specular"] > _MIRRORS
    return image.clamp(0, 1).contiguous(), mirrors


def _psnr_of_mirrors(
    run: ShownRun, splats: Gaussians, cameras: Sequence[Camera], seen: Sequence[tuple[Tensor, Tensor | None]]
) -> float | None:
    import torch

    from rtgs.train.held_out import psnr_of

    pairs = [
        (shown(run, splats, camera).clamp(0, 1)[:, mirrors], image[:, mirrors])
        for camera, (image, mirrors) in zip(cameras, seen)
        if mirrors is not None
    ]
    if not sum(image.numel() for _, image in pairs):
        return None
    mine, layered = (torch.cat([pair[k] for pair in pairs], 1) for k in (0, 1))
    return psnr_of(mine, layered)


def has_glass(run: ShownRun) -> bool:
    """Whether the model shows a transparent object by rays of its own, everywhere."""
    from rtgs.export.glass import glass_part

    return glass_part(run.method) is not None and not isinstance(run.mixture, Judged)


def _plain(run: ShownRun) -> Gaussians:
    (only,) = run.method.sets
    shown = only.shown()
    return shown.without_channels(*(channel.name for channel in shown.channels))


def _bake(
    run: ShownRun, settings: BakeSettings, cameras: Chosen, layered: Sequence[Tensor], wanted: BakeRecord
) -> tuple[Gaussians, BakeRecord]:
    """Render the layered model and fit one set to it."""
    from rtgs.export.bake import bake, joined
    from rtgs.train.held_out import psnr_of
    from rtgs.train.progress import progress_for

    begin = joined([part.shown() for part in run.method.sets if part.name in DIRECT])
    fitted = []
    for index, camera in enumerate(cameras.fitted):
        fitted.append((camera, _seen(run, camera, wanted.clear)[0]))
        if (index + 1) % _TELL_EVERY == 0 or index + 1 == len(cameras.fitted):
            print(f"  {index + 1} of {len(cameras.fitted)} pictures of the layered model", flush=True)
    held = list(zip(cameras.held, layered))
    baked = bake(run.scene, fitted, held, begin, run.method.settings.render, settings, progress_for())
    record = replace(wanted, views=baked.views, psnr=baked.psnr)
    photos = [view.image for view in run.scene.test]
    if photos and not wanted.clear:
        of_set = [psnr_of(shown(run, baked.gaussians, camera), photo) for camera, photo in zip(cameras.held, photos)]
        of_layers = [psnr_of(image, photo) for image, photo in zip(layered, photos)]
        record = replace(record, layered_photos=sum(of_layers) / len(photos), baked_photos=sum(of_set) / len(photos))
    return baked.gaussians, record


def _trained(run: ShownRun) -> dict[str, str]:
    """What the model was made of: another training of the same name is another model."""
    record = RunRecord.read(run.folder)
    assert record is not None  # open_run has read it
    return needed_steps(record)
