"""Normals of the object's mesh before and after its vertices were learned.

``python -m benchmarks.quality.learned_normals RUN_FOLDER ...``

Of runs of a shipped scene with a true container, with ``method.transmittance.vertices.rate`` above 0 (and
``method.transmittance.rim_samples`` 0): degrees between the normals of the mesh and the true ones, median and 90th
percentile over the visible glass of the test views, for the mesh that was found and the one at the end. Front and back
as of ``quality.object_normals``. The last line is a JSON object.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmarks.quality.mesh import opaque_depths
from benchmarks.quality.picture import artifact
from rtgs.core.errors import RtgsError
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.score import NormalScore, container_mesh, normal_score
from rtgs.methods.parts.glass import Glass
from rtgs.runs.training import load_method
from rtgs.scenes.canonical import read_scene
from rtgs.scenes.scene import Scene

HEADER = "| run | scene | mesh | front | back | moved |"


@dataclass(frozen=True)
class Row:
    """One mesh of one run."""

    run: str
    scene: str
    mesh: str  # found, learned
    normals: NormalScore
    moved: str  # of the learned one: what its decision says

    def line(self) -> str:
        """Of the table."""
        found = self.normals
        angles = f"{found.front:.2f} / {found.front_90:.1f} | {found.back:.2f} / {found.back_90:.1f}"
        return f"| {self.run} | {self.scene} | {self.mesh} | {angles} | {self.moved} |"


def measure(run: Path) -> list[Row]:
    """The meshes of a run.

    Raises:
        RtgsError: its scene has no true container, or its vertices were not learned.
    """
    scene = read_scene(artifact(run, "import_scene"))
    truth = container_mesh(scene.name)
    if truth is None:
        raise RtgsError(f"{run} is of scene {scene.name}, which has no true container: give a run of a shipped scene")
    method, _ = load_method(artifact(run, "train_transmittance"), scene)
    glass = method.parts["glass"]
    if not isinstance(glass, Glass) or glass.vertices is None or glass.guide is None:
        words = "method.transmittance.vertices.rate=0.03 method.transmittance.rim_samples=0"
        raise RtgsError(f"{run} learned no vertices: run with {words}")
    said = "; ".join(decision.why for decision in glass.vertices.decisions)
    meshes = (("found", glass.vertices.found, ""), ("learned", glass.guide.mesh, said))
    return [Row(run.name, scene.name, name, _score(mesh, scene), text) for name, mesh, text in meshes]


def _score(mesh: ObjectMesh, scene: Scene) -> NormalScore:
    truth = container_mesh(scene.name)
    assert truth is not None
    seen = [view for view in scene.test if view.mask is not None]
    views = [view.camera for view in seen]
    glass = [view.mask for view in seen if view.mask is not None]
    return normal_score(mesh, truth, views, glass, opaque_depths(scene.name.split(" ")[0], views))


def main() -> None:
    """Print the table, then a JSON object of all rows."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality.learned_normals", description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="folders that `rtgs run` filled")
    words = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{HEADER}\n{'|---' * (HEADER.count('|') - 1)}|")
    rows: list[Row] = []
    for run in words.runs:
        found = measure(run)
        print("\n".join(row.line() for row in found), flush=True)
        rows += found
    print(json.dumps({"rows": [asdict(row) for row in rows]}))


if __name__ == "__main__":
    main()
