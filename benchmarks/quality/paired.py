"""What a method gains over a reference, paired per test view and seed, with its spread and a verdict per scene.

    python -m benchmarks.quality.paired --preset standard --scenes toycar spheres --methods envgs rtgs \
        --more-seeds toycar=0,1,2

The runs are those of :mod:`benchmarks.quality.captures` (same words, same names): what the store holds is not run
again. A difference is the mean, over the test views, of ours minus the reference's of the same seed; its spread is the
standard deviation of that mean over the seeds. A scene with one seed is judged by the method's largest spread on the
others. Reference and methods must have trained for equally many steps.
"""

from __future__ import annotations

import argparse
import json
import shlex
import statistics
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.common.machine import machine
from benchmarks.quality.captures import Job, add_arguments, finish, over_seeds, scenes_here, table

WHERE = {"specular": "on specular objects", "masked": "in the masks"}
LAYERS = {"reflection": "reflected layer", "transmission": "transmitted layer"}
TIMES_THE_SPREAD = 2.0  # a gain counts above this multiple of its spread
WORSE = 0.1  # dB over all pixels that a method may lose
_DIFFERENCES = 3  # told of a run of another recipe


@dataclass(frozen=True)
class Run:
    """One finished run."""

    seed: int
    steps: int
    views: dict[str, dict[str, float | None]]  # test view, metric
    seconds: float  # CPU time of training, all threads
    gaussians: int

    def mean(self, metric: str) -> float | None:
        """Over the views that have it; None where none has."""
        known = [value for row in self.views.values() if (value := row.get(metric)) is not None]
        return statistics.fmean(known) if known else None

    def gain(self, other: Run, metric: str) -> float | None:
        """Mean over the views that both have of ours minus theirs; None without such a view.

        Raises ``ValueError`` when the runs were tested on different views or trained for different numbers of steps.
        """
        if self.views.keys() != other.views.keys():
            raise ValueError(f"test views {sorted(self.views)} against {sorted(other.views)}: not paired")
        if self.steps != other.steps:
            raise ValueError(f"{self.steps} steps against {other.steps}: not paired")
        pairs = [(row.get(metric), other.views[name].get(metric)) for name, row in self.views.items()]
        differences = [ours - theirs for ours, theirs in pairs if ours is not None and theirs is not None]
        return statistics.fmean(differences) if differences else None


def read_run(path: Path, seed: int) -> Run:
    """A run's ``metrics.json``."""
    record = json.loads(path.read_text(encoding="utf-8"))
    facts = record["facts"]
    views = {row["view"]: row["values"] for row in record["views"]}
    return Run(seed, facts["steps"], views, facts["train_cpu_seconds"], facts["surfels"])


@dataclass(frozen=True)
class Entry:
    """One line: the runs of a method on a scene, and the reference's of the same seeds."""

    scene: str
    method: str
    runs: tuple[Run, ...]
    reference: tuple[Run, ...]  # empty for the reference itself

    def values(self, metric: str) -> list[float]:
        """One value per seed."""
        return [value for run in self.runs if (value := run.mean(metric)) is not None]

    def gains(self, metric: str) -> list[float]:
        """One paired difference per seed that both have."""
        theirs = {run.seed: run for run in self.reference}
        found = [run.gain(theirs[run.seed], metric) for run in self.runs if run.seed in theirs]
        return [value for value in found if value is not None]


@dataclass(frozen=True)
class Verdict:
    """What a line says about a method; None: the runs do not tell."""

    scene: str
    method: str
    gain: float | None  # dB in the region judged
    spread: float | None
    spread_of: str | None  # the scene whose seeds gave the spread
    beats: bool | None
    gain_overall: float | None
    not_worse: bool | None

    def sentence(self, against: str, where: str) -> str:
        overall = "not known overall"
        if self.gain_overall is not None:
            overall = f"{self.gain_overall:+.2f} dB overall"
            overall += "" if self.not_worse else f", worse than {WORSE} dB"
        start = f"{self.scene}, {self.method}: "
        if self.gain is None:
            return f"{start}nothing is known {where}; {overall}"
        gain = f"{self.gain:+.2f} dB {where}"
        if self.spread is None:
            return f"{start}{gain}, spread unknown (one seed everywhere); {overall}"
        judged = "beats" if self.beats else "does not beat"
        source = f"+- {self.spread:.2f} on {self.spread_of}"
        return f"{start}{judged} {against} by more than {TIMES_THE_SPREAD:g}x the spread: {gain}, {source}; {overall}"


def verdicts(entries: Sequence[Entry], where: str) -> list[Verdict]:
    """One for each line with a reference; a scene with one seed borrows the method's largest spread."""
    metric = f"psnr_{where}"
    gains = {(entry.scene, entry.method): entry.gains(metric) for entry in entries if entry.reference}
    spreads = {key: statistics.stdev(values) for key, values in gains.items() if len(values) > 1}
    found = []
    for entry in entries:
        if not entry.reference:
            continue
        judged, overall = gains[entry.scene, entry.method], entry.gains("psnr")
        known = {scene: spread for (scene, method), spread in spreads.items() if method == entry.method}
        source = entry.scene if entry.scene in known else max(known, key=lambda scene: known[scene], default=None)
        gain = statistics.fmean(judged) if judged else None
        spread = None if source is None else known[source]
        beats = None if gain is None or spread is None else gain > TIMES_THE_SPREAD * spread
        all_pixels = statistics.fmean(overall) if overall else None
        not_worse = None if all_pixels is None else all_pixels >= -WORSE
        found.append(Verdict(entry.scene, entry.method, gain, spread, source, beats, all_pixels, not_worse))
    return found


def summary(found: Sequence[Verdict], against: str, where: str) -> list[str]:
    """For each method: on how many scenes it wins, by how much on average, and whether it loses anywhere."""
    lines = []
    for method in dict.fromkeys(verdict.method for verdict in found):
        own = [verdict for verdict in found if verdict.method == method]
        judged = [one for one in own if one.beats is not None]
        wins, losses = sum(bool(one.beats) for one in judged), [one.scene for one in own if one.not_worse is False]
        won = f"beats {against} on {wins} of {len(judged)} scenes" if judged else "its gain cannot be judged, no spread"
        gains = [one.gain for one in own if one.gain is not None]
        won += f", by {statistics.fmean(gains):+.2f} dB {where} on average over {len(gains)}" if gains else ""
        worse = f"worse than {WORSE} dB overall on {', '.join(losses)}" if losses else f"nowhere worse than {WORSE} dB"
        if unknown := [one.scene for one in own if one.not_worse is None]:
            worse += f" (not known on {', '.join(unknown)})"
        lines.append(f"{method}: {won}; {worse}")
    return lines


def columns(entries: Sequence[Entry], where: str) -> list[tuple[str, str, str]]:
    """(heading, metric, "value" or "gain") of the columns that some run fills."""

    def known(metric: str) -> bool:
        return any(entry.values(metric) for entry in entries)

    chosen = [("PSNR", "psnr", "value"), ("difference", "psnr", "gain")]
    if known(f"psnr_{where}"):
        chosen += [(WHERE[where], f"psnr_{where}", "value"), ("difference", f"psnr_{where}", "gain")]
    chosen.append(("SSIM", "ssim", "value"))
    if known(f"ssim_{where}"):
        chosen.append((f"SSIM {WHERE[where]}", f"ssim_{where}", "value"))
    for layer, words in LAYERS.items():
        if known(f"psnr_{layer}"):
            chosen += [(words, f"psnr_{layer}", "value"), ("scaled", f"psnr_{layer}_scaled", "value")]
    return chosen


def row(entry: Entry, chosen: Sequence[tuple[str, str, str]]) -> list[str]:
    """One line of the table."""

    def cell(metric: str, kind: str) -> str:
        values = entry.gains(metric) if kind == "gain" else entry.values(metric)
        if not values:
            return "-"
        return over_seeds(values, 4 if metric.startswith("ssim") else 2, "+" if kind == "gain" else "")

    return [
        entry.scene,
        entry.method,
        *(cell(metric, kind) for _, metric, kind in chosen),
        over_seeds([run.seconds for run in entry.runs], 0),
        f"{statistics.fmean(run.gaussians for run in entry.runs):,.0f}",
        " ".join(str(run.seed) for run in entry.runs),
    ]


def markdown(entries: Sequence[Entry], arguments: argparse.Namespace) -> str:
    """The table and what it says."""
    chosen = columns(entries, arguments.where)
    heads = ["scene", "method", *(head for head, _, _ in chosen), "train CPU s", "Gaussians", "seeds"]
    found = verdicts(entries, arguments.where)
    lines = [verdict.sentence(arguments.against, WHERE[arguments.where]) for verdict in found]
    said = "".join(f"- {line}\n" for line in (*lines, *summary(found, arguments.against, WHERE[arguments.where])))
    return f"{table([row(entry, chosen) for entry in entries], heads)}\n{said}"


def collect(scene: str, method: str, arguments: argparse.Namespace, failures: list[str]) -> tuple[Run, ...]:
    """The runs of all seeds; what failed, or with ``--finished`` is missing, is told."""
    runs = []
    for seed in arguments.seeds_of.get(scene, arguments.seeds):
        job = Job(scene, method, seed)
        path: Path | str = arguments.root / "runs" / job.name(arguments) / "metrics.json"
        if not arguments.finished:
            path = finish(job, arguments)
        elif not Path(path).is_file():
            path = "not run yet"
        elif other := another_recipe(Path(path).parent, job.words(arguments)):
            path = f"of another recipe than this preset and --set now are ({other})"
        if isinstance(path, str):
            failures.append(f"{scene}, {method}, seed {seed}: {path}")
            print(failures[-1], file=sys.stderr, flush=True)
        else:
            runs.append(read_run(path, seed))
    return tuple(runs)


def another_recipe(folder: Path, words: Sequence[str]) -> str:
    """Where the config of a finished run is another one than ``words`` compose, presets having changed or other words
    having been given; empty where it is the same. Keys that came later have their defaults."""
    import yaml

    from rtgs.config.compose import compose
    from rtgs.core.build import build
    from rtgs.core.errors import RtgsError
    from rtgs.core.recipe import flatten
    from rtgs.workflow.fingerprint import recipe_params

    config = compose(list(words))[0]
    kept = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    found = []
    for name, wanted in {"method": config.method, "schedule": config.schedule, "scene": config.scene}.items():
        try:
            made = flatten(recipe_params(build(type(wanted), kept[name])), name)
        except (RtgsError, ValueError) as error:
            return str(error)
        asked = flatten(recipe_params(wanted), name)
        found += [f"{key}: {made[key]} -> {asked[key]}" for key in asked if made[key] != asked[key]]
    rest = len(found) - _DIFFERENCES
    return ", ".join(found[:_DIFFERENCES]) + (f" and {rest} more" if rest > 0 else "")


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """All runs, the table written as it grows; the figures."""
    entries: list[Entry] = []
    failures: list[str] = []
    for scene in arguments.scenes:
        reference = collect(scene, arguments.against, arguments, failures)
        for method in dict.fromkeys([arguments.against, *arguments.methods]):
            runs = reference if method == arguments.against else collect(scene, method, arguments, failures)
            if runs:
                entry = Entry(scene, method, runs, () if method == arguments.against else reference)
                try:
                    entry.gains("psnr")
                    entries.append(entry)
                except ValueError as problem:
                    failures.append(f"{scene}, {method}: {problem}")
            write(arguments, entries, failures)
    print(f"\n{markdown(entries, arguments)}", flush=True)
    return {
        "machine": machine(),
        "preset": arguments.preset,
        "against": arguments.against,
        "where": arguments.where,
        "figures": [figures(entry, arguments.where) for entry in entries],
        "verdicts": [asdict(verdict) for verdict in verdicts(entries, arguments.where)],
        "failures": failures,
    }


def figures(entry: Entry, where: str) -> dict[str, Any]:
    """One line of the table: metric to one value per seed."""
    chosen = columns([entry], where)
    return {
        "scene": entry.scene,
        "method": entry.method,
        "seeds": [run.seed for run in entry.runs],
        "steps": entry.runs[0].steps,
        "train_cpu_seconds": [run.seconds for run in entry.runs],
        "gaussians": [run.gaussians for run in entry.runs],
        "mean": {metric: entry.values(metric) for _, metric, kind in chosen if kind == "value"},
        "gain": {metric: entry.gains(metric) for _, metric, kind in chosen if kind == "gain"},
    }


def write(arguments: argparse.Namespace, entries: Sequence[Entry], failures: Iterable[str]) -> None:
    """The table so far, with the command that makes it."""
    words = ["python", "-m", "benchmarks.quality.paired", "--preset", arguments.preset, "--against", arguments.against]
    words += ["--where", arguments.where, "--methods", *arguments.methods, "--seeds", *map(str, arguments.seeds)]
    words += ["--more-seeds", *arguments.more_seeds] if arguments.more_seeds else []
    words += ["--threads", str(arguments.threads), "--scenes", *arguments.scenes]
    words += ["--set", *arguments.set] if arguments.set else []
    text = f"`{shlex.join(words)}`\n\n{markdown(entries, arguments)}"
    text += "".join(f"- failed: {one}\n" for one in failures)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(text, encoding="utf-8")


def seeds_of(words: Iterable[str]) -> dict[str, list[int]]:
    """``toycar=0,1,2`` as a scene and its seeds."""
    found = {}
    for word in words:
        scene, separator, seeds = word.partition("=")
        if not separator or not all(seed.strip().isdecimal() for seed in seeds.split(",")):
            raise SystemExit(f"--more-seeds: {word!r} is not SCENE=SEED,SEED; write for instance toycar=0,1,2")
        found[scene] = [int(seed) for seed in seeds.split(",")]
    return found


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    add_arguments(parser, ("3dgs", "envgs", "rtgs"))
    add = parser.add_argument
    add("--against", default="2dgs", help="the reference, METHOD or METHOD+ABLATION (default: %(default)s)")
    add("--where", choices=list(WHERE), default="specular", help="pixels judged besides all (default: %(default)s)")
    add("--more-seeds", nargs="*", default=[], metavar="SCENE=0,1,2", help="the seeds of single scenes")
    add("--finished", action="store_true", help="run nothing: read what ROOT/runs holds of this recipe")
    add("--out", type=Path, help="Markdown file (default: ROOT/paired-PRESET.md)")
    arguments = parser.parse_args()
    arguments.scenes = arguments.scenes or scenes_here()
    arguments.seeds_of = seeds_of(arguments.more_seeds)
    arguments.out = arguments.out or arguments.root / f"paired-{arguments.preset}.md"
    return arguments


def main() -> None:
    print(json.dumps(measure(parse())))


if __name__ == "__main__":
    main()
