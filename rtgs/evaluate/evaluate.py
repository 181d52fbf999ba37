"""Score rendered test views: one row per view, means, spreads, and the reason wherever a number is absent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from torch import Tensor

from rtgs.core.names import unique_stems
from rtgs.evaluate.coverage import FRAMED_BY
from rtgs.evaluate.flip import flip_map
from rtgs.evaluate.images import ERROR_FULL_SCALE, error_map, error_scale_note, write_png
from rtgs.evaluate.layers import GLASS_LAYERS, LayerTruth, layer_scales, layer_scores, metrics_of, why_absent
from rtgs.evaluate.metrics import cc_psnr, psnr, quantized, ssim
from rtgs.evaluate.records import (
    COLOR_METRIC,
    FRAMED_METRICS,
    GIVEN_MASK_METRICS,
    METRICS,
    POSE_METRIC,
    SURFACE_METRICS,
    WHOLE_SURFACE_METRIC,
    EvaluationTable,
    ObjectFacts,
    RunFacts,
    ViewScore,
)
from rtgs.evaluate.settings import EvaluationSettings
from rtgs.evaluate.surface import depth_off, surface_scores
from rtgs.pretrained.lpips import InputRange, Lpips, lpips
from rtgs.pretrained.weights import MissingWeights, WrongWeights

NO_TEST_VIEWS = "the scene has no test views; scene.split_every=8 holds out every 8th"


class PhotoView(Protocol):
    """What evaluation needs of a test view; :class:`rtgs.scenes.scene.View` has it."""

    @property
    def name(self) -> str: ...
    @property
    def image(self) -> Tensor: ...  # (3, H, W) in [0, 1]
    @property
    def mask(self) -> Tensor | None: ...  # (H, W) bool
    @property
    def truth(self) -> LayerTruth | None: ...  # of path-traced captures


@dataclass(frozen=True)
class TimedRender:
    """A render of one test view."""

    image: Tensor  # (3, H, W)
    seconds: float | None = None  # wall time of the render call
    reflection: Tensor | None = None  # (3, H, W) k_s w_r C_r, of methods that render it
    transmission: Tensor | None = None  # (3, H, W) k_s w_t C_t, likewise
    given_masks: Tensor | None = None  # (3, H, W) the image through the view's own mask, likewise
    depth: Tensor | None = None  # (H, W) z-depth of the first surface
    normal: Tensor | None = None  # (3, H, W) of the first surface, camera frame, any length
    inner: Tensor | None = None  # (3, H, W) part of the transmission that is mirrored inside the glass, likewise
    contents: Tensor | None = None  # (3, H, W) part that comes straight from inside it
    behind: Tensor | None = None  # (3, H, W) part that comes straight through it
    framed: Tensor | None = None  # (H, W) training views that show what the pixel shows
    refined: Tensor | None = None  # (3, H, W) the image from a pose that was fitted to the photo


EVERYTHING = EvaluationSettings()


def load_lpips(settings: EvaluationSettings) -> tuple[Lpips | None, str]:
    """The LPIPS model, or None and the reason, to be printed in place of the figure."""
    if not settings.lpips:
        return None, "switched off (evaluation.lpips=false)"
    try:
        return Lpips.load(), ""
    except (MissingWeights, WrongWeights) as error:
        return None, str(error)


def evaluate_views(
    renders: Sequence[TimedRender],
    views: Sequence[PhotoView],
    facts: RunFacts,
    settings: EvaluationSettings = EVERYTHING,
    *,
    lpips_model: Lpips | None = None,
    object_facts: ObjectFacts | None = None,
) -> EvaluationTable:
    """Score ``renders[i]`` against ``views[i]``, at the resolution of the photo.

    ``lpips_model``: None loads the registered weights; without them the LPIPS columns stay None and
    :attr:`EvaluationTable.missing` says why.

    A scene without test views gives a table without rows, and :attr:`EvaluationTable.missing` says so for every metric.

    Raises:
        ValueError: another number of renders than views; and what :mod:`rtgs.evaluate.metrics` refuses, with the
            view's name.
    """
    if len(renders) != len(views):
        raise ValueError(f"{len(renders)} renders for {len(views)} test views of scene {facts.scene!r}")
    if not views:
        return EvaluationTable(facts, (), dict.fromkeys(METRICS, NO_TEST_VIEWS), object=object_facts)
    model, reason = (lpips_model, "") if lpips_model is not None and settings.lpips else load_lpips(settings)
    missing: dict[str, str] = {}
    if model is None:
        missing.update({name: reason for name in METRICS if name.startswith("lpips")})
    rows, scales = [], layer_scales(renders, views)
    for render, view in zip(renders, views, strict=True):
        try:
            score = _score(render, view, settings, model)
            score.values.update(layer_scores(render, view, scales))
        except (TypeError, ValueError) as error:
            raise type(error)(f"view {view.name!r}: {error}") from error
        rows.append(score)
    absent = [name for name in metrics_of(renders) if any(row.values.get(name) is None for row in rows)]
    missing |= {name: why_absent(name, renders, views) for name in absent}
    _explain_absent(rows, settings, missing)
    glass = {name: scale for name in GLASS_LAYERS if (scale := scales[name]) is not None}
    whole = (scales["reflection"], scales["transmission"])
    return EvaluationTable(facts, tuple(rows), missing, *whole, object_facts, glass)


def _score(render: TimedRender, view: PhotoView, settings: EvaluationSettings, model: Lpips | None) -> ViewScore:
    """All metrics of one view."""
    image, target, mask = render.image, view.image, view.mask
    values: dict[str, float | None] = dict.fromkeys(METRICS)
    values["psnr"], values["ssim"] = psnr(image, target), ssim(image, target)
    values[COLOR_METRIC] = cc_psnr(image, target)
    if render.refined is not None:
        values[POSE_METRIC] = psnr(render.refined, target)
    seen = flip_map(image, target)
    values["flip"] = float(seen.mean())
    values["render_seconds"] = render.seconds
    if render.framed is not None:
        framed = render.framed >= FRAMED_BY
        values["framed_share"] = float(framed.double().mean())
        values["psnr_framed"] = psnr(image, target, mask=framed) if bool(framed.any()) else None
    if view.truth is not None and render.depth is not None:
        values["depth_off"] = depth_off(render.depth, view.truth)
    if model is not None:
        for convention in InputRange:
            values[convention.value] = lpips(model, image, target, convention)
    if settings.masked and mask is not None and bool(mask.any()):
        values["psnr_masked"] = psnr(image, target, mask=mask)
        values["ssim_masked"] = ssim(image, target, mask=mask)
        values["flip_masked"] = float(seen[mask].mean())
        if model is not None:
            for convention in InputRange:
                values[f"{convention.value}_masked"] = lpips(model, image, target, convention, mask=mask)
        if view.truth is not None:
            values |= surface_scores(render.depth, render.normal, view.truth, mask)
    if settings.masked and render.given_masks is not None:
        values["psnr_given_masks"] = psnr(render.given_masks, target)
        if mask is not None and bool(mask.any()):
            values["psnr_masked_given_masks"] = psnr(render.given_masks, target, mask=mask)
            values["ssim_masked_given_masks"] = ssim(render.given_masks, target, mask=mask)
    if settings.eight_bit:
        image_8bit, target_8bit = quantized(image.double()), quantized(target.double())
        values["psnr_8bit"], values["ssim_8bit"] = psnr(image_8bit, target_8bit), ssim(image_8bit, target_8bit)
        if model is not None:
            values["lpips_01_8bit"] = lpips(model, image_8bit, target_8bit, InputRange.ZERO_ONE)
    share = None if mask is None else float(mask.double().mean())
    return ViewScore(view.name, int(target.shape[2]), int(target.shape[1]), share, values)


def _explain_absent(rows: Sequence[ViewScore], settings: EvaluationSettings, missing: dict[str, str]) -> None:
    """A reason for every metric that at least one view lacks."""
    for name in METRICS:
        absent = sum(row.values[name] is None for row in rows)
        if not absent or name in missing:
            continue
        if name.endswith("_8bit"):
            missing[name] = "switched off (evaluation.eight_bit=false)"
        elif (name.endswith("_masked") or name in GIVEN_MASK_METRICS) and not settings.masked:
            missing[name] = "switched off (evaluation.masked=false)"
        elif name in GIVEN_MASK_METRICS:
            missing[name] = "the method has no stage for transparent objects, or the view no mask"
        elif name == POSE_METRIC:
            missing[name] = "no poses are learned (method.poses.enabled, evaluation.refined_poses)"
        elif name in FRAMED_METRICS:
            missing[name] = f"{absent} of {len(rows)} views were rendered without maps, or show nothing that is framed"
        elif name == WHOLE_SURFACE_METRIC:
            missing[name] = "only path-traced captures know the depth, and the method must render it"
        elif name in SURFACE_METRICS:
            missing[name] = "only path-traced captures know the surface in the mask, and the method must render it"
        elif name.endswith("_masked"):
            missing[name] = f"{absent} of {len(rows)} views have no mask, or an empty one"
        else:
            missing[name] = f"not recorded for {absent} of {len(rows)} views"


def write_error_maps(
    renders: Sequence[TimedRender],
    views: Sequence[PhotoView],
    folder: Path,
    full_scale: float = ERROR_FULL_SCALE,
) -> list[Path]:
    """One PNG per view in ``folder``; the colour scale is in each file's description and in ``scale.txt``."""
    paths = []
    stems = unique_stems(view.name for view in views)
    for render, view in zip(renders, views, strict=True):
        path = folder / f"{stems[view.name]}.png"
        write_png(path, error_map(render.image, view.image, full_scale), error_scale_note(full_scale))
        paths.append(path)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scale.txt").write_text(error_scale_note(full_scale) + "\n", encoding="utf-8")
    return paths
