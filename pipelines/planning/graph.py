"""The graph of a run: (sfm, masks, normals ->) import -> a step per stage (+ others, mesh, judge) -> results.

Pure: from a config to steps with parameters; nothing runs here. Each step is given only what it reads.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial

from pipelines.planning.distilling import distilling_of
from pipelines.planning.ensemble import members_of
from pipelines.planning.inspection import Inspections
from pipelines.planning.judge import (
    Opponent,
    hold_out_views,
    judging_of,
    photos_as_judged,
    rest_of,
    until_judged,
    why_judged_late,
    why_photos_unseen,
    why_unjudged,
)
from pipelines.planning.mask_plan import draws_panes
from pipelines.planning.preparation import Preparation, prepare
from pipelines.planning.transparent import Transparency, find_transparency
from pipelines.steps import (
    evaluate,
    external,
    extract_mesh,
    import_scene,
    judge,
    masks,
    normals,
    pseudo_views,
    render,
    report,
    sfm,
    synthesize,
    train,
)
from rtgs.config.convert import judged, models_of, pictures_only
from rtgs.config.schema import OF_THE_MACHINE, Choices, RunConfig
from rtgs.core.decisions import Decision
from rtgs.core.recipe import flatten
from rtgs.methods import find_method
from rtgs.methods.settings import MethodSettings
from rtgs.pretrained.keys import ABSENT
from rtgs.runs.training import StageParams
from rtgs.train.networks import Named
from rtgs.train.settings import ScheduleSettings
from rtgs.workflow import Step, StepKind

KINDS: tuple[StepKind, ...] = (
    sfm.STEP,
    masks.STEP,
    normals.STEP,
    import_scene.STEP,
    pseudo_views.STEP,
    *train.training_kinds(),
    extract_mesh.STEP,
    judge.STEP,
    render.STEP,
    external.STEP,
    evaluate.STEP,
    report.STEP,
    synthesize.STEP,
)
"""Every kind of step there is; the guard against forgotten version bumps goes through them."""

_NOT_SHOWN = ("paths.", "tracking.", "table.", "scene.path", "method.paper_schedule.", *OF_THE_MACHINE)
_OF_TRAINING = ("method.", "schedule.", "mesh.", "seed", "ablation.", "distill.", "ensemble.")


@dataclass(frozen=True)
class RunGraph:
    """The steps of one run by what they give."""

    scene: Step
    training: tuple[Step, ...]
    render: Step
    evaluate: Step
    report: Step
    mesh: Step | None = None
    judge: tuple[Step, ...] = ()  # the plain method's training, the judge, the rest of that training
    distill: tuple[Step, ...] = ()  # teachers' trainings, and what they show around the photos
    members: tuple[Step, ...] = ()  # trainings of an ensemble's further models
    skipped: tuple[Decision, ...] = ()  # ``what`` is the name of the step
    unread: tuple[Decision, ...] = ()  # what the settings ask for and no step does
    moved: tuple[Decision, ...] = ()  # what happens at another time than in other scenes

    @property
    def targets(self) -> tuple[Step, ...]:
        """What a run asks for; everything else is upstream of it."""
        return (self.report,)


def build_graph(config: RunConfig, choices: Choices, inspections: Inspections | None = None) -> RunGraph:
    """The steps of ``rtgs run`` for this config. Reads the capture's poses and hashes its files, runs nothing.

    ``inspections``: of captures that other jobs of the same plan have looked at; None: this is the only job.

    Raises:
        CaptureError: the capture cannot be read.
        PrepareError: it has no poses and none may or can be looked for.
        ValueError: no method of this name.
    """
    config = _as_asked(config)
    inspection = (inspections or Inspections()).of(config.scene, config.sfm)
    prepared = prepare(config, inspection)
    scene = prepared.scene
    transparency = find_transparency(config, inspection, prepared)
    networks = tuple(found for found in _pretrained() if found[1] != ABSENT)  # without them the key stays as it was
    opponent = Opponent.of(config, choices)
    train_on = partial(_training, prepared=prepared, transparent=transparency.present, networks=networks)
    distilling = distilling_of(config, choices, scene, lambda own: train_on(own)[0])
    training, object_mesh = train_on(config, opponent=opponent, pseudo=distilling.pseudo)
    members = members_of(config, choices, lambda own: _with_mesh(*train_on(own)))
    judging = judging_of(config, opponent, scene, training, networks)
    judge_steps = () if judging is None else judging.steps
    if judging is not None:
        training += rest_of(training[-1], judging.judge, networks)
    rendered = _rendered(config, scene, *training, *judge_steps, *members.last)
    measured = evaluate.STEP.step(
        evaluate.EvaluateParams(config.evaluation, row_label(config, choices), choices.preset),
        scene,
        *training,
        *(() if object_mesh is None else (object_mesh,)),
        *judge_steps,
        *members.steps,
        rendered,
        tools=_pretrained() if config.evaluation.lpips else (),
    )
    skipped = (*prepared.skipped, *_left_out(config, transparency, object_mesh), *why_unjudged(config))
    mesh = object_mesh
    if mesh is None and config.mesh.extract:
        mesh = extract_mesh.STEP.step(_mesh_params(config), scene, *training)
    made = (rendered, measured) if mesh is None else (mesh, rendered, measured)
    unread = find_method(config.method.name).unread_losses(config.method)
    late = (*why_judged_late(config, opponent), *why_photos_unseen(config))
    moved = (*_in_this_scene(config, transparency.present), *late, *members.noted)
    params = _report_params(config, choices, skipped, (*unread, *moved))
    others = (*judge_steps, *members.steps)
    page = report.STEP.step(params, *prepared.steps, scene, *distilling.steps, *training, *others, *made)
    taught, further = distilling.steps, members.steps
    return RunGraph(
        scene, training, rendered, measured, page, mesh, judge_steps, taught, further, skipped, unread, moved
    )


def _rendered(config: RunConfig, scene: Step, *upstream: Step) -> Step:
    """The pictures of the test views: rendered, or another program's."""
    if not pictures_only(config):
        params = render.RenderParams(
            maps=True,
            supersample=config.evaluation.supersample,
            refine_steps=_refine_steps(config),
            refine_all=config.evaluation.refined_poses == "always",
        )
        return render.STEP.step(params, scene, *upstream)
    return external.STEP.step(external.external_params(config.external), scene, name=render.STEP.name)


def _refine_steps(config: RunConfig) -> int:
    """Steps that fit each test pose to its photo; 0: none is fitted."""
    wanted, spec = config.evaluation.refined_poses, find_method(config.method.name)
    if wanted == "always":
        spec.refuse_poses(config.method, "evaluation.refined_poses=always")
    may_learn = config.method.poses.enabled or (config.method.poses.learn_above is not None and spec.learns_poses)
    return config.evaluation.refine_steps if wanted == "always" or (wanted == "learned" and may_learn) else 0


def _as_asked(config: RunConfig) -> RunConfig:
    """``masks=none``: not those that the capture brings either. A judge has views held out."""
    config = hold_out_views(config)
    if config.masks.source != "none":
        return config
    return replace(config, scene=replace(config.scene, masks_dir=""))


def _left_out(config: RunConfig, transparency: Transparency, object_mesh: Step | None) -> tuple[Decision, ...]:
    """What a run of a method with a stage for transparent objects does without, and why."""
    stage = next((stage for stage in find_method(config.method.name).stages if stage.needs_object), None)
    if stage is None:
        return ()
    if object_mesh is None:
        why = f"{stage.start_key} leaves it no step" if transparency.present else transparency.why
        return (Decision(train.kind_of(stage).name, why),)
    if config.mesh.extract:
        why = f"extract_mesh makes the transparent object's mesh, which the {stage.name} stage needs"
        return (Decision("scene mesh", why),)
    return ()


def _training(
    config: RunConfig,
    *,
    prepared: Preparation,
    transparent: bool,
    networks: Named,
    opponent: Opponent | None = None,
    pseudo: tuple[Step, ...] = (),
) -> tuple[tuple[Step, ...], Step | None]:
    """One training step per stage, up to where it is judged, and the object mesh that a third one builds on."""
    scene = prepared.scene
    method: MethodSettings = replace(config.method, paper_schedule=ScheduleSettings())  # a preset has read it by now
    steps: list[Step] = []
    object_mesh = None
    spec = find_method(method.name)
    method = photos_as_judged(config, method.in_scene(glass=_through_glass(config, transparent)))
    if spec.elsewhere:
        return (), None
    for stage in until_judged(config, opponent, spec.timeline(method, config.schedule, transparent=transparent)):
        own = spec.stage(stage.name)
        read = own.reads(method)  # so that runs that differ elsewhere share the stage
        params = StageParams(read, config.schedule, config.seed, stage.name, stage.from_step, stage.until, config.watch)
        if own.needs_object:
            drawn = (step for step in prepared.steps if draws_panes(step))
            object_mesh = extract_mesh.STEP.step(extract_mesh.object_params(config), *drawn, scene, *steps)
        mesh = () if object_mesh is None else (object_mesh,)
        steps.append(train.train_step(spec, params, scene, *pseudo, *steps, *mesh, networks=networks))
    return tuple(steps), object_mesh


def _with_mesh(training: tuple[Step, ...], object_mesh: Step | None) -> tuple[Step, ...]:
    """All steps of a training, the object mesh before the first that waits for it."""
    if object_mesh is None:
        return training
    at = next(index for index, step in enumerate(training) if object_mesh in step.upstream)
    return (*training[:at], object_mesh, *training[at:])


def _through_glass(config: RunConfig, transparent: bool) -> bool:
    """Whether a stage for the transparent object is asked for, and there is one."""
    return transparent and find_method(config.method.name).object_stage(config.method) is not None


def _in_this_scene(config: RunConfig, transparent: bool) -> tuple[Decision, ...]:
    """What is otherwise in this scene than in others."""
    asked = config.method
    used = asked.in_scene(glass=_through_glass(config, transparent))
    found, what = [], "the scene has a transparent object"
    if used.reflection.start != (start := asked.reflection.start):
        why = f"{what} (method.reflection.start_before_glass; else {start:g})"
        found.append(Decision(f"reflection from {used.reflection.start:g} of the run on", why))
    if used.density.too_large != (large := asked.density.too_large):
        why = f"{what} (method.transmittance.base_too_large; else {large:g})"
        found.append(Decision(f"base surfels are too large from {used.density.too_large:g} extents on", why))
    return tuple(found)


def _mesh_params(config: RunConfig) -> extract_mesh.ExtractMeshParams:
    mesh = config.mesh
    return extract_mesh.ExtractMeshParams(mesh.tsdf, mesh.only_masked, mesh.depth_ratio, mesh.obj)


def _pretrained() -> tuple[tuple[str, str], ...]:
    """Which pretrained files LPIPS would find: the table changes when they arrive."""
    from rtgs.pretrained.weights import REGISTRY, MissingWeights, find_weights

    found = []
    for name, file in sorted(REGISTRY.items()):
        try:
            find_weights(file)
            found.append((name, file.sha256))
        except MissingWeights:
            found.append((name, ABSENT))
    return tuple(found)


def method_label(choices: Choices) -> str:
    """The method's name in tables; an ablation is part of it."""
    return choices.method if choices.ablation in ("", "none") else f"{choices.method}, {choices.ablation}"


def row_label(config: RunConfig, choices: Choices) -> str:
    """With what a judge does to it: such rows are not the pure method's. Of other programs' pictures their name."""
    if pictures_only(config):
        return config.external.name or method_label(choices)
    return f"{method_label(choices)}, judged" if judged(config) else method_label(choices)


def _report_params(
    config: RunConfig, choices: Choices, skipped: tuple[Decision, ...], noted: tuple[Decision, ...]
) -> report.ReportParams:
    values, defaults = shown_values(config), shown_values(RunConfig())
    lines = {key: (str(values[key]), str(defaults.get(key, ""))) for key in sorted(values)}
    mean = f", mean of {count}" if (count := models_of(config)) > 1 else ""
    title = f"{config.scene.name}: {row_label(config, choices)}, {choices.preset}{mean}"
    decisions = [(f"no {step.what} step", step.why) for step in skipped]
    decisions += [(each.what, each.why) for each in noted]
    if pictures_only(config):
        why = f"pictures of another program, from {config.external.renders}: nothing is trained"
        decisions.append(("external", why))
    return report.ReportParams(title, command(choices), lines, tuple(decisions))


def shown_values(config: RunConfig) -> dict[str, object]:
    """Every value that has to do with the result, by dotted key."""
    meshed = config.mesh.extract or find_method(config.method.name).object_stage(config.method) is not None
    hidden = _NOT_SHOWN if meshed else (*_NOT_SHOWN, "mesh.")
    hidden = (*hidden, *_OF_TRAINING) if pictures_only(config) else (*hidden, "external.")
    hidden = hidden if config.watch.on else (*hidden, "watch.")
    if not config.judge.plain and not config.scene.hold_out:  # pages of runs without a judge stay as they were
        hidden = (*hidden, "judge.", "scene.hold_out")
    hidden = hidden if config.distill.teachers else (*hidden, "distill.")
    hidden = hidden if models_of(config) > 1 else (*hidden, "ensemble.")
    return {key: value for key, value in flatten(asdict(config)).items() if not key.startswith(hidden)}


def command(choices: Choices) -> str:
    """The command line that repeats a run."""
    groups = {"scene": choices.scene_file, "method": choices.method, "preset": choices.preset}
    words = [f"{group}={name}" for group, name in groups.items() if name]
    words += [f"ablation={choices.ablation}"] if choices.ablation not in ("", "none") else []
    words += [f"experiment={choices.experiment}"] if choices.experiment else []
    return " ".join(["rtgs run", *words, *choices.overrides])
