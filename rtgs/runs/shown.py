"""A finished run as something that can be looked at from anywhere: its model, read back from the store."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.errors import RtgsError
from rtgs.runs.mixture import Mixture, is_member, read_mixture
from rtgs.runs.record import RUN_FILE, RunRecord, find_run
from rtgs.runs.training import last_training, load_method, object_mesh_of, read_history
from rtgs.runs.views import seen_maps
from rtgs.workflow import Store

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.gaussians.primitives import Gaussians
    from rtgs.mesh.container import ObjectMesh
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene

_NEEDED = ("import_scene", "train_", "judge", "plain")  # what the names of the steps that make a model begin with


@dataclass(frozen=True)
class LayeredView:
    """What a run shows from one camera, with the layers that the image is made of.

    ``view["reflection"]`` is the layer of that name, or one of the fields. A method without layers, as ``2dgs``, has
    fields only. Which layers there are, and how they add up: docs/look.md.
    """

    camera: Camera
    image: Tensor  # (3, H, W) sRGB, of one model not clamped; with what a judge replaced, or the mean of an ensemble
    depth: Tensor  # (H, W) z-depth of the base set in world units, divided by alpha; 0 where there is nothing
    alpha: Tensor  # (H, W) of the base set
    normal: Tensor | None  # (3, H, W) world frame; None: the method has none
    layers: Mapping[str, Tensor]  # (3, H, W) or (H, W) by name: diffuse, reflection, transmission, weights and more

    def __getitem__(self, name: str) -> Tensor:
        """The layer, or the field, of this name.

        Raises:
            KeyError: there is none; names those that there are.
        """
        fields = {"image": self.image, "depth": self.depth, "alpha": self.alpha, "normal": self.normal}
        found = {name: tensor for name, tensor in fields.items() if tensor is not None} | dict(self.layers)
        if name not in found:
            raise KeyError(f"this view has no layer {name!r}: it has {', '.join(found)}")
        return found[name]


@dataclass(frozen=True)
class ShownRun:
    """A finished run: its model with the scene that it was trained on. :func:`load` makes it."""

    folder: Path  # of the run, with its report
    scene: Scene  # what it was trained on; ``scene.test`` are the held-out views
    method: Model
    step: int  # as of which it is rendered: the end of its training
    mixture: Mixture | None  # of an ensemble, or what a judge replaced by a plain method; None: it is one model
    trainings: Mapping[str, Path]  # the artifacts of its stages

    @property
    def object_mesh(self) -> ObjectMesh | None:
        """Of the transparent object; None: the model has none."""
        return object_mesh_of(last_training(self.trainings))

    @property
    def history(self) -> list[dict[str, float]]:
        """The recorded metrics of all stages (:func:`rtgs.runs.training.read_history`)."""
        return [row for folder in self.trainings.values() for row in read_history(folder)]

    @property
    def name(self) -> str:
        """The run's name."""
        return self.folder.name

    @property
    def cameras(self) -> list[Camera]:
        """Of all photos of the capture, in the order of their names."""
        views = sorted((*self.scene.train, *self.scene.test), key=lambda view: view.name)
        return [view.camera for view in views]

    @property
    def sets(self) -> dict[str, Gaussians]:
        """The Gaussians by the name of their set: ``base``, and ``reflection``, ``transmittance`` and ``interface``
        where there are such, with the filter that they are rendered with."""
        return {each.name: each.shown() for each in self.method.sets}

    def maps(self, camera: Camera, mask: Tensor | None = None) -> dict[str, Tensor]:
        """What :meth:`render` gives, by name: ``image``, ``depth``, ``alpha``, ``normal`` and the layers."""
        maps = seen_maps(self.method, camera, self.step, mask)
        return maps if self.mixture is None else maps | {"image": self.mixture.of(camera, maps["image"], mask)}

    def render(self, camera: Camera, mask: Tensor | None = None) -> LayeredView:
        """The view of a camera, all sets together.

        Parameters
        ----------
        camera : Camera
            In the scene's frame: one of :attr:`cameras`, of a view, of :func:`rtgs.orbit_cameras`, or your own.
        mask : (H, W) bool Tensor, optional
            Pixels that show a transparent object, for methods that see through glass; without it, where the mesh of
            the object is seen. Given a test view's camera and mask, the image is the run's rendered one to the bit.

        Returns
        -------
        LayeredView
            The image, its maps and layers; without gradients.
        """
        maps = self.maps(camera, mask)
        image, depth, alpha, normal = (maps.pop(name, None) for name in ("image", "depth", "alpha", "normal"))
        assert image is not None
        assert depth is not None
        assert alpha is not None
        return LayeredView(camera, image, depth, alpha, normal, maps)


def load(run: str | Path | None = None, root: str | Path | None = None) -> ShownRun:
    """A finished run, ready to render from anywhere.

    The scene and the model are read from the store that lies beside the ``runs`` folder. Nothing is trained.

    Parameters
    ----------
    run : str or Path, optional
        The folder of a run, or its name in ``root/runs``. Without it: the run that finished last.
    root : str or Path, optional
        The folder with ``runs/`` and ``store/``: without it ``RTGS_ROOT``, or the working directory.

    Returns
    -------
    ShownRun
        It renders: ``rtgs.load("bottle").render(camera).image``.

    Raises
    ------
    RtgsError
        There is no such run, its record is damaged, or the store has not its model any more; says what makes it again.
    """
    root = Path(os.environ.get("RTGS_ROOT", ".") if root is None else root)
    return open_run(locate_run(root, None if run is None else str(run)))


def locate_run(root: Path, name: str | None) -> Path:
    """The folder of a run: given as a folder, by its name in ``root/runs``, or None: the one that finished last.

    Raises:
        RtgsError: there is none, or its record is damaged.
    """
    if name is not None and (Path(name) / RUN_FILE).is_file():
        return Path(name).absolute()
    return find_run(root / "runs", name)


def needed_steps(record: RunRecord) -> dict[str, str]:
    """The steps that make a run's model and its scene, by name: their fingerprints."""
    return {name: key for name, key in record.steps.items() if name.startswith(_NEEDED) or is_member(name)}


def open_run(folder: Path, store: Store | None = None) -> ShownRun:
    """Read the model of a run folder from the store (None: the one that lies beside ``runs/``).

    Raises:
        RtgsError: the folder's record is missing or damaged, or the store has not what the run was made of.
    """
    from rtgs.scenes.canonical import read_scene

    record = RunRecord.read(folder)
    if record is None:
        raise RtgsError(f"{folder} is no run folder: {RUN_FILE} is not there")
    store = store or Store(folder.absolute().parent.parent / "store")
    wanted = needed_steps(record)
    if missing := [name for name, key in wanted.items() if not store.has(name, key)]:
        raise RtgsError(
            f"{folder.name}: {', '.join(missing)} is not in {store.root} any more; `{record.command}` makes it again"
        )
    places = {name: store.folder_of(name, key) for name, key in wanted.items()}
    scene = read_scene(places["import_scene"])
    method, stage = load_method(last_training(places), scene)
    trainings = {name: place for name, place in places.items() if name.startswith("train_")}
    return ShownRun(folder, scene, method, stage.until, read_mixture(places, scene), trainings)
