"""Models trained on the same photos show what they agree on: their mean picture from places around the photos."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.steps.training import read_summary
from rtgs.runs.mixture import evaluated
from rtgs.runs.training import PSEUDO_VIEWS, load_method
from rtgs.workflow import StepContext, StepKind

TEACHER = "teacher"  # what the names of the steps begin with that train the models


@dataclass(frozen=True)
class PseudoParams:
    """How many, and from where.

    Attributes:
        views: visits of pseudo views for each visit of a photo.
        most: pictures that are rendered at most; beyond, each is visited more often.
        seed: of the cameras.
    """

    views: int
    most: int
    seed: int


def pseudo_views(params: PseudoParams, context: StepContext) -> None:
    """Write ``images/`` and ``pseudo_views.json`` (:mod:`rtgs.runs.pseudo`): the mean of the teachers' pictures.

    The teachers are trained models among the inputs. They show what they have learned of the scene, without what they
    learned of single photos, such as exposures.

    Raises:
        RtgsError: there are fewer than two photos.
    """
    import torch

    from rtgs.core.memory import share_one_heap
    from rtgs.runs.pseudo import PseudoRecord, write_picture
    from rtgs.scenes.around import cameras_around
    from rtgs.scenes.canonical import read_scene
    from rtgs.scenes.scene import View
    from rtgs.train.clock import Clock, ElapsedTime
    from rtgs.train.seeds import generator_for

    share_one_heap()
    clock = Clock()
    scene = context.read("import_scene", read_scene)
    teachers = [folder for name, folder in context.inputs.items() if name.startswith(TEACHER)]
    visits = params.views * len(scene.train)
    cameras = cameras_around(
        [view.camera for view in scene.train],
        scene.extent,
        min(visits, params.most),
        generator_for(params.seed, PSEUDO_VIEWS),
    )
    models = [load_method(folder, scene) for folder in teachers]
    entries = []
    for index, camera in enumerate(cameras):
        pictures = [evaluated(method, stage.until, camera).clamp(0, 1) for method, stage in models]
        view = View(camera, torch.stack(pictures).mean(0), None, None, camera.name)
        entries.append(write_picture(context.out, index, view))
    trainings = [read_summary(folder) for folder in teachers]
    spent = sum((ElapsedTime(each.seconds, each.cpu_seconds) for each in trainings), clock.elapsed())
    peak = max(each.peak_memory_mb for each in trainings)
    PseudoRecord(tuple(entries), visits, spent.wall, spent.cpu, peak).write(context.out)
    context.log.info("%d pictures of %d models, visited %d times", len(entries), len(models), visits)


STEP = StepKind(PSEUDO_VIEWS, 1, pseudo_views)
