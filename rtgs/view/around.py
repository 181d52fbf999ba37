"""What stands around the model on the page: cameras with their photos and masks, the mesh of the object."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from rtgs.core.errors import RtgsError
from rtgs.evaluate.images import to_bytes
from rtgs.mesh.hull import carve_hull
from rtgs.mesh.settings import HullSettings
from rtgs.mesh.silhouettes import mask_set
from rtgs.render.paths import around, several_places
from rtgs.report.figures import outlined

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]  (an extra)

    from rtgs.core.cameras import Camera
    from rtgs.mesh.container import ObjectMesh
    from rtgs.mesh.triangles import TriangleMesh
    from rtgs.scenes.scene import Scene, View

_LINE = 2.0  # pixels
_THUMB = 128  # pixels of a photo's long side in its frustum
_TRAIN, _TEST = (90, 160, 220), (240, 150, 60)
_GLASS, _HULL = (140, 200, 210), (200, 170, 220)
_HULL_VOXELS = 48  # along its longest side
_FRUSTUM = 0.06  # of the scene's extent
_SOURCES = {"hull": "hull of the masks", "tsdf": "fused from depths", "given": "from a file"}


class Surroundings:
    """Switches for cameras, photos, masks and the mesh; nothing of it is shown until it is asked for.

    Parameters
    ----------
    server : viser.ViserServer
        Whose page it is on.
    changed : callable
        Called when something was switched.
    """

    def __init__(self, server: viser.ViserServer, changed: Callable[[object], None]) -> None:
        self._server = server
        self._scene: Scene | None = None
        self._frusta: list[Any] = []
        self._mesh: Any = None
        self._hull: Any = None
        self._pictured = ""  # what the frusta hold
        self._lock = threading.RLock()  # pages and the training switch things in threads of their own
        with server.gui.add_folder("Capture"):
            gui = server.gui
            self._cameras = gui.add_checkbox("cameras", False, hint="blue: training, orange: test; a click goes there")
            self._photos = gui.add_checkbox("photos", False, visible=False, hint="in the cameras")
            self._masks = gui.add_checkbox("masks", False, visible=False, hint="outlined in the photos")
            self._meshed = gui.add_checkbox("mesh", False, visible=False)
            hint = "carved when it is first asked for, which takes a second or more"
            self._hulled = gui.add_checkbox("hull of the masks", False, visible=False, hint=hint)
            self._size = gui.add_slider("size of cameras", 0.2, 3.0, 0.1, 1.0, visible=False)
        for each in (self._cameras, self._photos, self._masks, self._meshed, self._hulled, self._size):
            each.on_update(self._update)
            each.on_update(changed)

    @property
    def visible(self) -> bool:
        """Whether anything stands in the picture."""
        meshes = ((self._mesh, self._meshed), (self._hull, self._hulled))
        return bool(self._cameras.value or any(mesh is not None and switch.value for mesh, switch in meshes))

    def show(self, scene: Scene, mesh: ObjectMesh | None) -> None:
        """The capture and the object of a model that is shown from now on."""
        with self._lock:
            self._show(scene, mesh)

    def _show(self, scene: Scene, mesh: ObjectMesh | None) -> None:
        if scene is not self._scene:
            self._scene = scene
            self._place(scene)
            for frustum in self._frusta:
                frustum.remove()
            self._frusta, self._pictured = [], ""
            self._hulled.visible = scene.has_masks
        if mesh is not None:
            self._meshed.label = f"mesh, {_SOURCES.get(mesh.source, mesh.source)}"
            self._meshed.visible = True
            self._mesh = self._add("/mesh", mesh.mesh, _GLASS)
        self._update()

    def _place(self, scene: Scene) -> None:
        """Where a page that is opened looks from: as the first training view, at what the photos look at."""
        cameras = [view.camera for view in (*scene.train, *scene.test)]
        first = cameras[0]
        up = -sum((camera.rotation[1] for camera in cameras), torch.zeros(3, dtype=torch.float64))
        target = first.center + scene.extent * first.rotation[2]
        if several_places(cameras):
            orbit = around(cameras).orbit
            up = orbit.up
            if float(first.to_camera(orbit.target)[2]) > 0:
                target = first.center + float(first.to_camera(orbit.target)[2]) * first.rotation[2]
        scale = max(1e-9, scene.extent)
        start = self._server.initial_camera
        self._server.scene.set_up_direction(_triple(up / up.norm().clamp_min(1e-12)))
        start.position, start.look_at = _triple(first.center), _triple(target)
        start.up = _triple(-first.rotation[1])
        start.fov = vertical_fov(first)
        start.near, start.far = 1e-3 * scale, 1e3 * scale

    def _update(self, _event: object = None) -> None:
        with self._lock:
            self._apply()

    def _apply(self) -> None:
        """What the switches say."""
        shown = bool(self._cameras.value)
        if shown and self._scene is not None:
            if not self._frusta:
                self._build(self._scene)
            self._picture(self._scene)
        for frustum in self._frusta:
            frustum.visible = shown
        has_masks = self._scene is not None and self._scene.has_masks
        for switch, there in ((self._photos, True), (self._masks, has_masks), (self._size, True)):
            if switch.visible != (shown and there):
                switch.visible = shown and there
        if self._hulled.value and self._hull is None and self._scene is not None and not self._hulled.disabled:
            self._carve(self._scene)
        for mesh, switch in ((self._mesh, self._meshed), (self._hull, self._hulled)):
            if mesh is not None:
                mesh.visible = bool(switch.value)

    def _carve(self, scene: Scene) -> None:
        """A rough hull; where there is none, the switch says why."""
        try:
            self._hull = self._add("/hull", rough_hull(scene), _HULL)
        except RtgsError as error:
            self._hulled.label = f"no hull: {error}"
            self._hulled.disabled = True

    def _add(self, name: str, mesh: TriangleMesh, color: tuple[int, int, int]) -> Any:
        return self._server.scene.add_mesh_simple(
            name,
            mesh.vertices,
            mesh.faces,
            color=color,
            opacity=0.7,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )

    def _build(self, scene: Scene) -> None:
        """One frustum for each photo; a click takes the page to its camera."""
        for color, views in ((_TRAIN, scene.train), (_TEST, scene.test)):
            for view in views:
                camera = view.camera
                frustum = self._server.scene.add_camera_frustum(
                    f"/cameras/{len(self._frusta):05d}",
                    vertical_fov(camera),
                    camera.width / camera.height,
                    scale=self._scale(scene),
                    thickness=_LINE,
                    thickness_units="screen",
                    color=color,
                    wxyz=quaternion(camera),
                    position=_triple(camera.center),
                    cast_shadow=False,
                    receive_shadow=False,
                )
                frustum.on_click(lambda event, camera=camera: _go_to(event.client, camera))
                self._frusta.append(frustum)

    def _picture(self, scene: Scene) -> None:
        """Photos in the frusta, or nothing; with their masks outlined."""
        wanted = f"{self._photos.value} {self._masks.value}"
        for frustum, view in zip(self._frusta, (*scene.train, *scene.test), strict=True):
            frustum.scale = self._scale(scene)
            if wanted != self._pictured:
                frustum.image = thumbnail(view, masked=self._masks.value) if self._photos.value else None
        self._pictured = wanted

    def _scale(self, scene: Scene) -> float:
        return _FRUSTUM * scene.extent * float(self._size.value)


def rough_hull(scene: Scene) -> TriangleMesh:
    """The visual hull of the training views' masks, on a coarse grid, where one mask may be wrong.

    Raises:
        RtgsError: the masks bound no volume.
    """
    views = scene.train
    masks = mask_set([view.camera for view in views], [view.mask for view in views])
    return carve_hull(masks, HullSettings(voxels=_HULL_VOXELS, outvoted=1, trim=False)).mesh


def thumbnail(view: View, *, masked: bool) -> np.ndarray:
    """(h, w, 3) uint8 of a photo, ``_THUMB`` pixels at most; its mask outlined and what is beside it darker."""
    from PIL import Image

    pixels = to_bytes(view.image)
    if masked and view.mask is not None:
        dark = np.where(view.mask.numpy()[..., None], pixels, pixels // 3)
        pixels = outlined(dark, view.mask)
    picture = Image.fromarray(pixels)
    picture.thumbnail((_THUMB, _THUMB), Image.Resampling.BOX)
    return np.asarray(picture)


def vertical_fov(camera: Camera) -> float:
    """Of a photo's height, radians."""
    return 2 * math.atan(camera.height / 2 / camera.fy)


def quaternion(camera: Camera) -> tuple[float, float, float, float]:
    """(w, x, y, z) from camera to world."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(camera.rotation.T.numpy()).as_quat()
    return float(w), float(x), float(y), float(z)


def _go_to(client: viser.ClientHandle, camera: Camera) -> None:
    """Look as a photo was taken."""
    with client.atomic():
        client.camera.up_direction = _triple(-camera.rotation[1])
        client.camera.position = _triple(camera.center)
        client.camera.wxyz = quaternion(camera)
        client.camera.fov = vertical_fov(camera)


def _triple(values: torch.Tensor) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
