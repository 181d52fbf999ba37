"""What a judge on photos adds to a run: views that are held out, the plain method's training, and the judge."""

from __future__ import annotations

from dataclasses import replace

from pipelines.planning.preparation import Preparation
from pipelines.steps import judge, train
from rtgs.config.compose import compose_plain
from rtgs.config.convert import judged
from rtgs.config.schema import Choices, RunConfig
from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.methods import find_method
from rtgs.runs.training import StageParams
from rtgs.train.networks import Named
from rtgs.train.settings import ScheduleSettings
from rtgs.workflow import Step


def hold_out_views(config: RunConfig) -> RunConfig:
    """The config of a run with a judge imports the scene with held-out views."""
    if not judged(config):
        return config
    return replace(config, scene=replace(config.scene, hold_out=config.scene.hold_out or config.judge.every))


def why_unjudged(config: RunConfig) -> tuple[Decision, ...]:
    """Why a run that asks for a judge has none; empty: it has one, or asks for none."""
    if not config.judge.plain or judged(config):
        return ()
    return (Decision(judge.STEP.name, f"{config.method.name} is the plain method itself (judge.plain)"),)


def judge_steps(
    config: RunConfig, choices: Choices, prepared: Preparation, training: tuple[Step, ...], networks: Named
) -> tuple[Step, ...]:
    """The plain method's training and the judge; none where nothing is judged. The plain method has its own numbers at
    the preset of the run, and its seed.

    Raises:
        hydra.errors.HydraException: judge.plain is no file of conf/method.
        RtgsError: it is a method of more than one stage.
        MissingWeights: it reads a network that is not there.
    """
    if not judged(config):
        return ()
    method, schedule = compose_plain(config.judge.plain, choices)
    spec = find_method(method.name)
    stage, *more = spec.timeline(method, schedule)
    if more:
        names = ", ".join(each.name for each in (stage, *more))
        raise RtgsError(f"judge.plain={config.judge.plain} trains in several stages ({names}): give a method of one")
    read = spec.stage(stage.name).reads(replace(method, paper_schedule=ScheduleSettings()))
    stretch = StageParams(read, schedule, config.seed, stage.name, stage.from_step, stage.until)
    plain = train.train_step(spec, stretch, prepared.scene, networks=networks, name=judge.PLAIN)
    params = judge.JudgeParams(find_method(config.method.name).name, spec.name)
    return plain, judge.STEP.step(params, prepared.scene, *training, plain)
