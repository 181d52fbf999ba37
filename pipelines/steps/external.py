"""Renders of the test views by another program, in the form in which this project's own are stored."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from pipelines.steps.render import RenderTimes
from rtgs.core.records import read_record, write_json
from rtgs.evaluate.settings import ExternalSettings
from rtgs.workflow import NOT_IN_RECIPE, StepContext, StepKind

RECORD = "external.json"


@dataclass(frozen=True)
class ExternalParams:
    """How the pictures are read, and what they hold: not where they lie."""

    settings: ExternalSettings
    """Without name and folders."""
    files: str
    """Digest of every picture."""
    renders: str = field(metadata=NOT_IN_RECIPE)
    layers: str = field(metadata=NOT_IN_RECIPE)


@dataclass(frozen=True)
class ExternalRecord:
    """``external.json``: what a reader of the figures should know of the pictures."""

    notes: tuple[str, ...] = ()

    def write(self, folder: Path) -> None:
        """Write ``folder/external.json``."""
        write_json(folder / RECORD, {"notes": self.notes})

    @staticmethod
    def read(folder: Path) -> ExternalRecord | None:
        """Read ``folder/external.json``; None: the pictures are this project's own.

        Raises:
            RtgsError: it is damaged.
        """
        return read_record(ExternalRecord, folder / RECORD) if (folder / RECORD).is_file() else None


def external_params(settings: ExternalSettings) -> ExternalParams:
    """Parameters of the step; reads the pictures' bytes.

    Raises:
        ExternalError: no folder is named, a folder is none, or holds no pictures.
        CaptureError: a file cannot be read.
    """
    from rtgs.evaluate.external import ExternalError, picture_files
    from rtgs.scenes.digest import files_digest

    if not settings.renders:
        raise ExternalError(
            "method=external, but external.renders is empty: give the folder that holds the other program's picture of "
            "each test view"
        )
    digests = []
    for key in ("renders", "layers"):
        if place := getattr(settings, key):
            folder = Path(place)
            digests.append(files_digest(key, folder, picture_files(folder, f"external.{key}")))
    plain = replace(settings, renders="", layers="", name="")
    return ExternalParams(plain, " ".join(digests), settings.renders, settings.layers)


def take_renders(params: ExternalParams, context: StepContext) -> None:
    """Write what the step ``render`` writes: ``images/``, ``views/``, ``render.json`` without times; ``external.json``.

    Raises:
        ExternalError: a picture is missing, of another size or of another colour space.
        CaptureError: a picture cannot be read.
    """
    from safetensors.torch import save_file

    from rtgs.core.names import unique_stems
    from rtgs.evaluate.external import read_external
    from rtgs.evaluate.images import to_bytes, write_png
    from rtgs.scenes.canonical import read_scene

    scene = context.read("import_scene", read_scene)
    settings = replace(params.settings, renders=params.renders, layers=params.layers)
    found = read_external(settings, scene.test)
    stems = unique_stems(view.name for view in scene.test)
    (context.out / "views").mkdir()
    for name, tensors in found.views.items():
        save_file(dict(tensors), context.out / "views" / f"{stems[name]}.safetensors")
        write_png(context.out / "images" / f"{stems[name]}.png", to_bytes(tensors["image"]))
    RenderTimes(dict.fromkeys(found.views)).write(context.out)
    ExternalRecord(found.notes).write(context.out)
    for note in found.notes:
        context.log.info("%s", note)


STEP = StepKind("external", 1, take_renders)
