"""Render Gaussians along a circle, one picture a frame: around a trained model or the points of a capture.

python examples/05_render_path.py --out out/05 [--ply model.ply] --frames 60

Most tools make a film of the frames, for example ``ffmpeg -i out/05/%03d.png film.mp4``.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import rtgs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/05"))
    parser.add_argument("--scene", default="embedded:ball_statue", help="its cameras say where the circle is")
    parser.add_argument("--ply", type=Path, help="Gaussians in the capture's frame, of any tool")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--width", type=int, default=160)
    options = parser.parse_args()

    scene = rtgs.load_scene(rtgs.SceneSettings(path=options.scene, long_side=64, max_views=24))
    if options.ply:
        gaussians = rtgs.read_gaussians(options.ply)
    else:
        start = rtgs.InitSettings(opacity=0.8)
        generator = rtgs.generator_for(0, "initialise")
        gaussians = rtgs.gaussians_from_points(rtgs.Surfels, scene.points, scene.point_colors, start, generator)

    # The circle that the photos were taken from. Any other path is a list of cameras too.
    orbit = rtgs.orbit_of_cameras([view.camera for view in scene.train])
    higher = replace(orbit, elevation=orbit.elevation + 10)
    picture = rtgs.Picture(options.width, options.width * 3 // 4)
    for index, camera in enumerate(rtgs.orbit_cameras(higher, picture, options.frames)):
        image = rtgs.render_splats(gaussians, camera, near=0.02 * scene.extent)
        rtgs.write_png(options.out / f"{index:03d}.png", rtgs.to_bytes(image))
    print(f"wrote {options.frames} frames to {options.out}")


if __name__ == "__main__":
    main()
