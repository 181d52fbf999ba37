"""Small motions of the training cameras, learned with the scene (docs/photos.md; gsplat's pose optimisation).

The scene and all cameras may drift together. So a test camera moves as the training cameras nearest to it have moved;
nothing of its own photo is known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.decisions import Decision
from rtgs.methods.parts.exposure import have_own_names, nearest_photos, rows_by_name, told
from rtgs.methods.parts.part import Frame, Part
from rtgs.render.pose import NUMBERS, moved, rotation_of
from rtgs.train.method import RenderedView
from rtgs.train.parameters import ParameterGroup, Rate
from rtgs.train.terms import LossTerm

if TYPE_CHECKING:
    from rtgs.methods.settings import MethodSettings
    from rtgs.methods.spec import MethodSpec, Setup
    from rtgs.scenes.scene import Scene, View

NEAREST = 4  # training cameras that a test camera follows
LIMITS = (-0.3, 0.3)  # of all numbers: beyond it poses are to be searched for anew, and within it rows stay apart


class Poses(Part):
    """A translation and a rotation for each training view; test views follow the nearest, other cameras stay."""

    name = "poses"

    def __init__(self, setup: Setup) -> None:
        """Raises RtgsError where views cannot be told apart by their names."""
        settings = setup.settings.poses
        self.rows = rows_by_name(setup.scene, "method.poses.enabled")
        self.extent = setup.scene.extent
        unseen = (*setup.scene.test, *setup.scene.held)
        self.nearest = {view.camera.name: nearest_photos(view.camera, setup.scene, NEAREST) for view in unseen}
        self.decay = settings.decay
        rate = Rate(settings.rate, settings.rate_end, max(setup.schedule.total, 1))
        self.group = ParameterGroup(self.name, {"deltas": torch.zeros(len(self.rows), NUMBERS)}, rate, limits=LIMITS)

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return (self.group,)

    @property
    def decisions(self) -> tuple[Decision, ...]:
        deltas = self.group["deltas"].detach()
        found = ""
        if bool(deltas.any()):
            shift = self.extent * float(torch.linalg.vector_norm(deltas[:, :3], dim=1).mean())
            found = f", moved by {shift:.3g} world units and {_degrees(deltas):.2g} degrees on average"
        why = f"method.poses.enabled, {len(self.rows)} cameras{found}; a test camera moves as the {NEAREST} nearest do"
        return (Decision("poses of the training cameras learned", why),)

    def aim(self, frame: Frame) -> Frame:
        """From the camera as it is moved by now, with its graph where there is one to be."""
        delta = self._of(frame.camera.name)
        if delta is None:
            return frame
        pose = moved(frame.camera, delta, self.extent)
        return replace(frame, camera=pose.of(frame.camera), pose=pose if pose.rotation.requires_grad else None)

    def _of(self, name: str) -> Tensor | None:
        """(9,) motion of the view of this name; None: it has none, and nothing tells it."""
        if (row := self.rows.get(name)) is not None:
            return self.group["deltas"][row]
        near = self.nearest.get(name)
        return None if near is None else told(self.group["deltas"].detach(), near)

    def terms(self) -> Iterator[LossTerm]:
        """Half the squares, whose gradient is Adam's weight decay."""

        def squares(rendered: RenderedView, view: View) -> Tensor:
            return 0.5 * self.group["deltas"].square().sum()

        if self.decay > 0:
            yield LossTerm("pose_decay", self.decay, squares)


def as_posed(spec: MethodSpec, settings: MethodSettings, scene: Scene) -> tuple[MethodSettings, tuple[Decision, ...]]:
    """The settings with poses learned where those of the scene are unsure, and what decided it."""
    poses = settings.poses
    if poses.enabled or poses.learn_above is None:
        return settings, ()
    if not spec.learns_poses and (scene.pose_error is None or scene.pose_error <= poses.learn_above):
        return settings, ()
    key = f"method.poses.learn_above is {poses.learn_above:g}"
    if scene.pose_error is None:
        return settings, (Decision("no poses learned", f"the capture does not tell how sure its poses are ({key})"),)
    unsure = f"what the points miss the photos by leaves a pose unsure by {scene.pose_error:.3f} pixels"
    if scene.pose_error <= poses.learn_above:
        return settings, (Decision("no poses learned", f"{unsure}, and {key}"),)
    if not spec.learns_poses:
        why = f"{unsure}, but the rays that method {spec.name} traces give no gradient of the camera"
    elif not have_own_names(scene):
        why = f"{unsure}, but names do not tell the cameras apart"
    else:
        asked = replace(settings, poses=replace(poses, enabled=True))
        return asked, (Decision("poses of the capture are unsure", f"{unsure}, and {key}"),)
    return settings, (Decision("no poses learned", why),)


def _degrees(deltas: Tensor) -> float:
    """Mean angle of the rotations."""
    traces = torch.stack([rotation_of(delta[3:].double()).trace() for delta in deltas])
    return float(((traces - 1) / 2).clamp(-1, 1).acos().mean().rad2deg())
