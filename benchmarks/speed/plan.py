"""How long a plan of many steps takes: graphs, keys, look-ups in the store, reasons.

The steps are those of the shipped scenes with every method under many seeds; the store holds an artifact for each of
them, with as many files as the steps write. Nothing is trained: the files are empty, their sizes and digests recorded.

    python -m benchmarks.speed.plan [--steps 1000]

Times are CPU seconds of this process, the lowest of three. Keys of the last line: ``warm`` all steps are cached;
``one_key_changed`` every training and all after it is missing, explained against the nearest artifact; ``cold`` nothing
is cached; each of them from configs to the printed table. ``compose`` what Hydra takes before that, one job of each
scene and method and its seeds, per job; ``find`` the look-ups alone.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from benchmarks.common.machine import machine
from pipelines.cli.plan import merged_table
from pipelines.planning.plan import Job, MergedJobs, merge_jobs
from rtgs.config.sweep import compose_jobs
from rtgs.workflow import Plan, Step, Store, make_plan, topological
from rtgs.workflow.manifest import FileRecord, Manifest

SCENES = "sedan,spheres,toycar,ball_statue,matte_room"
METHODS = "2dgs,3dgs,envgs,rtgs"
FILES = {"import_scene": 50, "render": 13, "evaluate": 8}  # of other steps: 6
_DIGEST = "0" * 64


def main() -> None:
    """Print the figures; the last line is JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000, help="at least this many (default: %(default)s)")
    wanted = parser.parse_args().steps
    jobs, compose_seconds = _jobs(seeds=2)
    while len(topological(merge_jobs(jobs).targets)) < wanted:  # more seeds, without composing each of them
        seed = max(job.config.seed for job in jobs) + 1
        first = [job for job in jobs if job.config.seed == 0]
        jobs += [Job(replace(job.config, seed=seed, name=f"{job.title}-seed{seed}"), job.choices) for job in first]
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / "store")
        for step in topological(merge_jobs(jobs).targets):
            _publish(step, store)
        figures = _measure(jobs, store, Store(Path(folder) / "empty"))
    figures |= {"jobs": len(jobs), "compose_s_per_job": round(compose_seconds, 4)}
    for key, value in figures.items():
        print(f"{key:24} {value}")
    print(json.dumps({"benchmark": "plan", **figures, "machine": machine()}))


def _jobs(seeds: int) -> tuple[list[Job], float]:
    """Every scene with every method under the first seeds, and CPU seconds of composing one of them."""
    seed = ",".join(str(number) for number in range(seeds))
    start = time.process_time()
    composed, _ = compose_jobs([f"scene={SCENES}", f"method={METHODS}", f"seed={seed}", "preset=smoke"], True)
    seconds = (time.process_time() - start) / len(composed)
    return [Job(job.config, job.choices) for job in composed if job.config and job.choices], seconds


def _measure(jobs: list[Job], store: Store, empty: Store) -> dict[str, float]:
    changed = [
        Job(replace(job.config, schedule=replace(job.config.schedule, sh_every=41)), job.choices) for job in jobs
    ]
    targets = merge_jobs(jobs).targets
    steps = topological(targets)
    return {
        "steps": len(steps),
        "warm_s": _lowest(lambda: _whole_plan(jobs, store)),
        "one_key_changed_s": _lowest(lambda: _whole_plan(changed, store)),
        "cold_s": _lowest(lambda: _whole_plan(jobs, empty)),
        "graphs_s": _lowest(lambda: merge_jobs(jobs)),
        "find_s": _lowest(lambda: make_plan(targets, store)),
    }


def _whole_plan(jobs: list[Job], store: Store) -> str:
    """What ``rtgs plan --multirun`` does once the jobs are composed."""
    merged: MergedJobs = merge_jobs(jobs)
    plan: Plan = make_plan(merged.targets, store)
    return merged_table(merged, plan)


def _publish(step: Step, store: Store) -> None:
    """An artifact of empty files, with a manifest as the step would write it."""
    folder = store.folder(step)
    folder.mkdir(parents=True)
    names = [f"{index:05d}.safetensors" for index in range(FILES.get(step.name, 6))]
    for name in names:
        (folder / name).touch()
    upstream = {other.name: other.fingerprint for other in step.upstream}
    files = {name: FileRecord(0, _DIGEST) for name in names}
    created = "2026-01-01T00:00:00+00:00"
    recipe = (step.name, step.version, step.fingerprint, step.recipe, upstream, dict(step.tools))
    Manifest(*recipe, files, 1.0, created).write(folder)


def _lowest(action: Callable[[], object], rounds: int = 3) -> float:
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        action()
        seconds.append(time.process_time() - start)
    return round(min(seconds), 3)


if __name__ == "__main__":
    main()
