"""Trace rays through surfels: a picture from camera rays, and one from their mirror images at what they meet.

python examples/02_trace_rays.py --out out/02
"""

import argparse
from pathlib import Path

import torch

import rtgs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/02"))
    parser.add_argument("--scene", default="embedded:spheres", help="a folder with a capture, or embedded:NAME")
    parser.add_argument("--size", type=int, default=120, help="long side of the pictures in pixels")
    options = parser.parse_args()

    scene = rtgs.load_scene(rtgs.SceneSettings(path=options.scene, long_side=options.size, max_views=8))
    start = rtgs.InitSettings(opacity=0.8)
    generator = rtgs.generator_for(0, "initialise")
    surfels = rtgs.gaussians_from_points(rtgs.Surfels, scene.points, scene.point_colors, start, generator)
    camera = scene.train[0].camera
    rows = rtgs.activate_gaussians(surfels.requires_grad_(False), camera.center.float(), sh_degree=3)
    shape = (rows.means, rows.tangent_u, rows.tangent_v, rows.scales, rows.opacities)
    tree = rtgs.SurfelTree().build(*shape)
    print(f"a tree of {tree.nodes} nodes over {tree.surfels} surfels")

    # One ray for each pixel. The directions have z = 1 in the camera's frame, so the traced depth is the z-depth.
    rays = camera.rays()
    directions = rays.directions.reshape(-1, 3)
    origins = rays.origin.expand_as(directions)
    colors = {"tree": tree, "sh_dc": surfels.sh_dc, "sh_rest": surfels.sh_rest}
    maps = rtgs.TraceOptions(t_min=0.02 * scene.extent, depth=True, normal=True)
    seen = rtgs.trace_surfels(*shape, origins, directions, options=maps, **colors)
    assert seen.colors is not None
    assert seen.depth is not None
    assert seen.normal is not None

    # The mirror ray starts at the point that was met, a little above it.
    points = origins + (seen.depth / seen.alpha.clamp_min(1e-6))[:, None] * directions
    normals = torch.nn.functional.normalize(seen.normal, dim=1)
    mirrored = directions - 2 * (directions * normals).sum(1, keepdim=True) * normals
    mirrored = torch.nn.functional.normalize(mirrored, dim=1)
    above = rtgs.TraceOptions(t_min=0.01 * scene.extent)
    reflected = rtgs.trace_surfels(*shape, points, mirrored, options=above, **colors)
    assert reflected.colors is not None

    for name, values in (("seen", seen.colors), ("mirrored", reflected.colors)):
        image = values.T.reshape(3, camera.height, camera.width)
        rtgs.write_png(options.out / f"{name}.png", rtgs.to_bytes(image))
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
