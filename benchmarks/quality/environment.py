"""A run's environment map against the true one of its path-traced scene.

``python -m benchmarks.quality.environment RUN [RUN ...] [--scene FILE] [--samples N] [--png FILE]``

Runs are folders, or names in ``runs/``, of a method with a far light, on a capture that the path tracer made: a shipped
one, or of ``--scene``. The truth is what surrounds the largest mirror, path-traced from its middle without anything
that mirrors. Only directions count that a training photo shows mirrored there, each by its solid angle. PSNR in dB of
colours as they are seen: as the model has them, and after one gain for each colour in linear light (a mirror's weight
and its light explain the same photo in many ways). Beside it the PSNR of the run's reflected layer on mirrors. The
scene's own environment is near, but for ``benchmarks/scenes/far_balls.toml``: there a perfect map is possible.

``--png``: truth and maps one below the other, what nothing mirrors is dark. The last line is a JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.light.pictures import light_picture, mean_frame, panorama_directions
from rtgs.optics.light import decoded, encoded
from rtgs.runs.shown import ShownRun, load
from rtgs.scenes.synthetic.description import SPECULAR, SceneDescription, named_scene, read_description
from rtgs.scenes.synthetic.render import PathTracer

HEIGHT = 64  # of the panorama
SAMPLES = 256
SHARP = 0.03  # roughness up to which a mirror's ray is one direction
LEAST_PIXELS = 1  # training pixels that show a direction


@dataclass(frozen=True)
class Score:
    """Of one run."""

    run: str
    seen: float  # share of the sphere that a training photo shows mirrored
    psnr: float  # dB
    psnr_after_gain: float
    reflection: float | None  # dB of the reflected layer on mirrors, test views


@dataclass(frozen=True)
class Truth:
    """What is around the largest mirror."""

    panorama: np.ndarray  # (HEIGHT, 2 HEIGHT, 3) encoded, in ``frame``
    seen: np.ndarray  # (HEIGHT, 2 HEIGHT) bool
    frame: np.ndarray  # (3, 3) right, up, backward in the world


def largest_mirror(scene: SceneDescription) -> int:
    """Index of the sharpest large sphere that mirrors.

    Raises:
        RtgsError: there is none.
    """
    balls = [
        (shape.size[0], index)
        for index, shape in enumerate(scene.shapes)
        if shape.kind == "sphere" and shape.material.kind == "mirror" and shape.material.roughness <= SHARP
    ]
    if not balls:
        raise RtgsError(f"{scene.name} has no mirror ball: take spheres, or benchmarks/scenes/far_balls.toml")
    return max(balls)[1]


def true_panorama(scene: SceneDescription, ball: int, frame: np.ndarray, samples: int, seed: int) -> np.ndarray:
    """(HEIGHT, 2 HEIGHT, 3) encoded colours around the middle of a ball, without what mirrors, from six cameras."""
    matte = replace(scene, shapes=tuple(each for each in scene.shapes if each.material.kind not in SPECULAR))
    tracer = PathTracer(matte, seed)
    center = torch.tensor(scene.shapes[ball].position, dtype=torch.float64)
    faces = []
    for number, axes in enumerate(face_axes()):
        rotation, half = torch.from_numpy(axes), HEIGHT / 2
        camera = Camera(rotation, -rotation @ center, half, half, half, half, HEIGHT, HEIGHT, f"face{number}")
        faces.append(encoded(torch.from_numpy(tracer.image(camera, samples)), "linear").clamp(0, 1).numpy())
    return looked_up(np.stack(faces), panorama_directions(HEIGHT, frame))


def face_axes() -> np.ndarray:
    """(6, 3, 3) right, down and forward of six square cameras that see everything."""
    found = []
    for axis in range(3):
        for forward in (np.eye(3)[axis], -np.eye(3)[axis]):
            down = np.eye(3)[axis - 1]
            found.append([np.cross(down, forward), down, forward])
    return np.array(found)


def looked_up(faces: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The nearest texels of faces (6, side, side, 3) along directions (..., 3)."""
    side, axes = faces.shape[1], face_axes()
    flat = directions.reshape(-1, 3)
    face = (flat @ axes[:, 2].T).argmax(1)
    local = np.einsum("pij,pj->pi", axes[face], flat)
    place = ((local[:, :2] / local[:, 2:] + 1) * side / 2).astype(int).clip(0, side - 1)
    return faces[face, place[:, 1], place[:, 0]].reshape(directions.shape)


def mirrored(scene: SceneDescription, ball: int, cameras: list[Camera], frame: np.ndarray, seed: int) -> np.ndarray:
    """(HEIGHT, 2 HEIGHT) how many training pixels show each direction mirrored in the ball."""
    tracer = PathTracer(scene, seed)
    counts = np.zeros((HEIGHT, 2 * HEIGHT), int)
    for camera in cameras:
        found = tracer.geometry(camera)
        rotation = camera.rotation.numpy()
        view = camera.rays(torch.float64).directions.reshape(-1, 3).numpy()
        view = view / np.linalg.norm(view, axis=1, keepdims=True)
        normal = found.normal.reshape(-1, 3) @ rotation
        here = found.shape.reshape(-1) == ball
        ray = (view - 2 * (view * normal).sum(1, keepdims=True) * normal)[here] @ frame.T
        longitude = np.arctan2(ray[:, 0], -ray[:, 2]) / (2 * math.pi) + 0.5
        latitude = np.arccos(ray[:, 1].clip(-1, 1)) / math.pi
        column = (longitude * 2 * HEIGHT).astype(int) % (2 * HEIGHT)
        row = (latitude * HEIGHT).astype(int).clip(0, HEIGHT - 1)
        np.add.at(counts, (row, column), 1)
    return counts


def solid_angles() -> np.ndarray:
    """(HEIGHT, 1) weight of a panorama's rows."""
    return np.cos(math.pi * (0.5 - (np.arange(HEIGHT) + 0.5) / HEIGHT))[:, None]


def psnr(found: np.ndarray, truth: np.ndarray, weight: np.ndarray) -> float:
    """dB of (H, W, 3) pictures, pixels weighted by (H, W)."""
    error = ((found.clip(0, 1) - truth) ** 2).mean(-1)
    return float(-10 * np.log10((weight * error).sum() / weight.sum()))


def with_gain(found: np.ndarray, truth: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """``found`` times the gain for each colour, in linear light, that is closest to the truth."""
    ours, theirs = (decoded(torch.from_numpy(each), "linear").double().numpy() for each in (found.clip(0, None), truth))
    gain = (weight[..., None] * ours * theirs).sum((0, 1)) / (weight[..., None] * ours**2).sum((0, 1)).clip(1e-12)
    return encoded(torch.from_numpy(gain * ours), "linear").numpy()


def truth_of(run: ShownRun, scene: SceneDescription, samples: int, seed: int) -> Truth:
    """Raises RtgsError: the scene has no mirror ball."""
    ball = largest_mirror(scene)
    frame = mean_frame(torch.stack([camera.rotation for camera in run.cameras]))
    photos = [view.camera for view in run.scene.train]
    seen = mirrored(scene, ball, photos, frame, seed) >= LEAST_PIXELS
    return Truth(true_panorama(scene, ball, frame, samples, seed), seen, frame)


def score(run: ShownRun, truth: Truth) -> tuple[Score, np.ndarray]:
    """The score of a run, and its panorama.

    Raises:
        RtgsError: the run's method has no far light.
    """
    light = run.method.light
    if light is None:
        raise RtgsError(f"{run.name}: method {run.method.spec.name} has no far light to compare")
    found = light_picture(light, panorama_directions(HEIGHT, truth.frame))
    weight = truth.seen * solid_angles()
    share = float(weight.sum() / (solid_angles().sum() * 2 * HEIGHT))
    fitted = with_gain(found, truth.panorama, weight)
    before, after = (psnr(each, truth.panorama, weight) for each in (found, fitted))
    return Score(run.name, share, before, after, _reflection(run)), found


def _reflection(run: ShownRun) -> float | None:
    """dB of the reflected layer on what mirrors, from the run's own metrics."""
    record = json.loads((run.folder / "metrics.json").read_text(encoding="utf-8"))
    known = [row["values"].get("psnr_reflection") for row in record["views"]]
    known = [value for value in known if value is not None]
    return sum(known) / len(known) if known else None


def shipped(name: str) -> SceneDescription:
    """The shipped scene that a run's is called after; a label behind the name (``spheres (stand-in)``) is ignored."""
    return named_scene(name.split(" ")[0])


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.quality.environment",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--scene", type=Path, help="description of the capture; default: the shipped one of its name")
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--seed", type=int, default=0, help="of the capture's textures")
    parser.add_argument("--png", type=Path)
    options = parser.parse_args()
    truth, scores, pictures = None, [], []
    try:
        for name in options.runs:
            run = load(name)
            scene = read_description(options.scene) if options.scene else shipped(run.scene.name)
            truth = truth or truth_of(run, scene, options.samples, options.seed)
            one, picture = score(run, truth)
            scores.append(one)
            pictures.append(picture)
            layer = "-" if one.reflection is None else f"{one.reflection:.2f}"
            print(
                f"{one.run:40s} map {one.psnr:6.2f} dB, after a gain {one.psnr_after_gain:6.2f} dB, over "
                f"{100 * one.seen:.0f} % of all directions; reflected layer {layer} dB",
                flush=True,
            )
    except (RtgsError, ValueError) as error:
        parser.error(str(error))
    assert truth is not None
    if options.png:
        dark = np.where(truth.seen[..., None], 1.0, 0.3)
        rows = np.concatenate([dark * each.clip(0, 1) for each in (truth.panorama, *pictures)])
        cv2.imwrite(str(options.png), np.round(255 * rows[..., ::-1]).astype(np.uint8))
    print(json.dumps([asdict(one) for one in scores]))


if __name__ == "__main__":
    main()
