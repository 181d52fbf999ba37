"""Trainings end with the bits they ended with when methods were classes: digests recorded by the code of that time.

Compared are all stages of the four methods on ball_statue and toycar, preset ``smoke`` and 300 steps
of ``quick``. ``golden_checkpoints.json`` holds their digests by step and key. One instruction set, one PyTorch and
processors of one maker made them; on others, bits differ, and the test is skipped. A stage that gets a new version gets
new keys, and keeps its digests here where its bits are the old ones. When a recipe or a result is meant to change, its
lines go. Those of rtgs and of toycar were recorded anew when the core got threads of its own: the compiler then took
one sum of the photometric loss in another order; those of traced sets when gradients came to be summed by groups of
packets.

Where the captures themselves are others, all keys are. ``RTGS_ROOT=FOLDER python -m
tests.pipelines.steps.test_same_checkpoints [METHOD ...]`` then records the digests of this code and this machine, after
those of the code before have been compared on the old captures; lines of the same key are written anew.
"""

from __future__ import annotations

import json
import os
import sys
from hashlib import sha256
from pathlib import Path

import pytest
import torch

from pipelines.cli.main import main
from rtgs.native import core
from rtgs.workflow import Store

FILE = Path(__file__).with_name("golden_checkpoints.json")
GOLDEN = json.loads(FILE.read_text())
CASES = [(scene, method) for scene in ("ball_statue", "toycar") for method in ("2dgs", "3dgs", "envgs", "rtgs")]
# What the presets and rtgs have become since.
OLD_STARTS = ("method.reflection.start_before_glass=null", "method.transmittance.start=0.5")
SHORT = ("preset=quick", "schedule.total=300", *OLD_STARTS)
OLD_RATES = (
    "method.optimizer.decay_from=1.0",
    "method.init.orientation=published",
    "method.density.max_per_point=null",
)
OLD_GLASS = ("ablation=learned_glass", "mesh.object.surface.fit=carved")


def maker() -> str:
    """Of the processor: PyTorch's libraries take other paths for others."""
    found = Path("/proc/cpuinfo")
    lines = found.read_text().splitlines() if found.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("vendor_id")), "unknown")


HERE = {"isa": core.isa(), "torch": torch.__version__, "processor": maker()}
SAME = all(GOLDEN.get(name) == value for name, value in HERE.items())


def digests(scene: str, method: str, root: Path) -> dict[str, str]:
    """Train both presets in ``RTGS_ROOT``, which is ``root``: digest of every checkpoint by step and key."""
    for words in (("preset=smoke",), SHORT):
        old = (*OLD_RATES, *(OLD_GLASS if method == "rtgs" else ()))
        run = ["run", f"scene={scene}", f"method={method}", *words, *old, "tracking=off", "threads=1"]
        assert main(run) == 0
    found = {}
    for artifact in Store(root / "store").artifacts():
        if artifact.manifest.step.startswith("train_"):
            key = f"{artifact.manifest.step} {artifact.manifest.fingerprint[:16]}"
            found[key] = sha256((artifact.folder / "checkpoint" / "state.safetensors").read_bytes()).hexdigest()
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "method"), CASES)
def test_checkpoints_have_the_recorded_bits(scene: str, method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    if not SAME:
        pytest.skip(f"recorded with {', '.join(GOLDEN[name] for name in HERE)}")
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))
    found = digests(scene, method, tmp_path)
    known = {key: GOLDEN["checkpoints"][key] for key in found if key in GOLDEN["checkpoints"]}
    stages = {"2dgs": 1, "3dgs": 1, "envgs": 2, "rtgs": 3 if scene == "ball_statue" else 2}[method]  # toycar: no masks
    assert len(known) == 2 * stages, "of both presets"
    assert {key: found[key] for key in known} == known


if __name__ == "__main__":
    kept = GOLDEN["checkpoints"] if SAME else {}
    for scene, method in CASES:
        if method in (sys.argv[1:] or [method]):
            kept |= digests(scene, method, Path(os.environ["RTGS_ROOT"]))
    document = HERE | {"checkpoints": dict(sorted(kept.items()))}
    FILE.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
