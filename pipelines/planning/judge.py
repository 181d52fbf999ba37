"""What a judge on photos adds to a run: views that are held out, the plain method's training, and the judge."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pipelines.steps import judge, train
from rtgs.config.compose import compose_plain
from rtgs.config.convert import judged
from rtgs.config.schema import Choices, RunConfig
from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.methods import Stage, find_method
from rtgs.methods.photo_settings import AppearanceSettings, PoseSettings
from rtgs.methods.settings import MethodSettings
from rtgs.runs.mixture import PLAIN, REST
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


@dataclass(frozen=True)
class Opponent:
    """The plain method of a judge: its own numbers at the preset of the run."""

    method: MethodSettings
    schedule: ScheduleSettings

    @staticmethod
    def of(config: RunConfig, choices: Choices) -> Opponent | None:
        """Of a run; None: nothing is judged.

        Raises:
            hydra.errors.HydraException: judge.plain is no file of conf/method.
        """
        if not judged(config):
            return None
        method, schedule = compose_plain(config.judge.plain, choices)
        return Opponent(photos_as_judged(config, method), schedule)


@dataclass(frozen=True)
class Judging:
    """The steps of a judge."""

    plain: Step  # the plain method's training, up to where it is judged
    judge: Step
    rest: tuple[Step, ...]  # of the plain method's training

    @property
    def steps(self) -> tuple[Step, ...]:
        """All of them, in order."""
        return (self.plain, self.judge, *self.rest)


def until_judged(config: RunConfig, opponent: Opponent | None, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """The stages of a training up to where it is judged: within the last one, or at its end."""
    if not stages or opponent is None or _learned_of_photos(config, opponent):
        return stages
    *others, last = stages
    at = last.from_step + round(config.judge.at * (last.until - last.from_step))
    return (*others, replace(last, until=max(at, last.from_step + 1)))


def why_judged_late(config: RunConfig, opponent: Opponent | None) -> tuple[Decision, ...]:
    """Why a run is judged at its end though its judge is asked for earlier; empty: it is not."""
    if opponent is None or config.judge.at == 1 or not (learned := _learned_of_photos(config, opponent)):
        return ()
    why = f"{learned[0]} learns something of each photo, and those that join late would come too late for it"
    return (Decision("judged at the end of the run", why),)


def _learned_of_photos(config: RunConfig, opponent: Opponent) -> tuple[str, ...]:
    """What is on by which one of the two methods learns something of each training photo."""
    names = {"method": config.method, f"method={config.judge.plain}: method": opponent.method}
    keys = ("poses", "appearance")
    return tuple(f"{of}.{key}.enabled" for of, own in names.items() for key in keys if getattr(own, key).enabled)


def photos_as_judged(config: RunConfig, method: MethodSettings) -> MethodSettings:
    """Settings of a training whose photos join in two parts: it does not look whether their exposures differ or their
    poses are unsure, for those that join late would come too late to learn theirs."""
    if not _looks_too_early(config):
        return method
    appearance, poses = (replace(each, learn_above=None) for each in (method.appearance, method.poses))
    return replace(method, appearance=appearance, poses=poses)


def why_photos_unseen(config: RunConfig) -> tuple[Decision, ...]:
    """Why a judged run does not look at its photos' exposures and poses; empty: it does, or was not asked to."""
    if not _looks_too_early(config):
        return ()
    looked: dict[str, AppearanceSettings | PoseSettings] = {
        "exposures of photos not compared": config.method.appearance
    }
    if find_method(config.method.name).learns_poses:
        looked["poses of photos not judged"] = config.method.poses
    unseen = [what for what, each in looked.items() if not each.enabled and each.learn_above is not None]
    why = f"some photos join at {config.judge.at:g} of the last stage (judge.at), too late to learn theirs"
    return tuple(Decision(what, why) for what in unseen)


def _looks_too_early(config: RunConfig) -> bool:
    return judged(config) and config.judge.at < 1


def judging_of(
    config: RunConfig, opponent: Opponent | None, scene: Step, training: tuple[Step, ...], networks: Named
) -> Judging | None:
    """The judge of a run whose ``training`` goes up to where it is judged; None: nothing is judged. The plain method
    has the seed of the run.

    Raises:
        RtgsError: the plain method is one of more than one stage.
        MissingWeights: it reads a network that is not there.
    """
    if opponent is None:
        return None
    method, schedule = opponent.method, opponent.schedule
    spec = find_method(method.name)
    stage, *more = spec.timeline(method, schedule)
    if more:
        names = ", ".join(each.name for each in (stage, *more))
        raise RtgsError(f"judge.plain={config.judge.plain} trains in several stages ({names}): give a method of one")
    read = spec.stage(stage.name).reads(replace(method, paper_schedule=ScheduleSettings()))
    whole, own = config.schedule.total, training[-1].params.until
    at = max(round(schedule.total * own / whole), 1)  # the same share of both runs
    stretch = StageParams(read, schedule, config.seed, stage.name, stage.from_step, at)
    plain = train.train_step(spec, stretch, scene, networks=networks, name=PLAIN)
    params = judge.JudgeParams(find_method(config.method.name).name, spec.name, (own, at) if own < whole else None)
    decided = judge.STEP.step(params, scene, *training, plain)
    return Judging(plain, decided, rest_of(plain, decided, networks))


def rest_of(last: Step, decided: Step, networks: Named) -> tuple[Step, ...]:
    """What goes on with a training after the judge (``decided``); none where it is at its end."""
    params, total = last.params, last.params.schedule.total
    if params.until == total:
        return ()
    rest = replace(params, until=total, joined=params.until)
    spec, upstream = find_method(params.method.name), (*last.upstream, last, decided)
    return (train.train_step(spec, rest, *upstream, networks=networks, name=f"{last.name}{REST}"),)
