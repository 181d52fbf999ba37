"""Open a capture, make Gaussians of its points (or read a PLY file), rasterise them, write pictures.

python examples/01_open_and_rasterize.py --out out/01 [--ply model.ply]
"""

import argparse
from pathlib import Path

import rtgs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/01"))
    parser.add_argument("--scene", default="embedded:ball_statue", help="a folder with a capture, or embedded:NAME")
    parser.add_argument("--ply", type=Path, help="Gaussians in the capture's frame, of any tool")
    parser.add_argument("--size", type=int, default=160, help="long side of the pictures in pixels")
    options = parser.parse_args()

    settings = rtgs.SceneSettings(path=options.scene, long_side=options.size, max_views=8)
    scene = rtgs.load_scene(settings)
    print(scene.summary())

    if options.ply:
        gaussians = rtgs.read_gaussians(options.ply)
    else:
        start = rtgs.InitSettings(opacity=0.8)
        generator = rtgs.generator_for(0, "initialise")
        gaussians = rtgs.gaussians_from_points(rtgs.Surfels, scene.points, scene.point_colors, start, generator)
    print(f"{len(gaussians)} {type(gaussians).__name__.lower()}")

    # Raw parameters become what a renderer takes. Colours are those seen from this camera.
    camera, near = scene.train[0].camera, 0.02 * scene.extent
    rows = rtgs.activate_gaussians(gaussians, camera.center.float(), sh_degree=3)
    shape = (rows.means, rows.tangent_u, rows.tangent_v, rows.scales, rows.opacities)
    if isinstance(gaussians, rtgs.Ellipsoids):
        maps = rtgs.EllipsoidOptions(near=near, depth=True)
        buffers = rtgs.rasterize_ellipsoids(*shape, rows.colors, camera, options=maps)
    else:
        maps = rtgs.RasterOptions(near=near, depth=True)
        buffers = rtgs.rasterize_surfels(*shape, rows.colors, camera, options=maps)

    assert buffers.depth is not None
    depth = buffers.depth / buffers.alpha.clamp_min(1e-6)  # accumulated along the ray, so it is divided by alpha
    rtgs.write_png(options.out / "photo.png", rtgs.to_bytes(scene.train[0].image))
    rtgs.write_png(options.out / "image.png", rtgs.to_bytes(buffers.features))
    rtgs.write_png(options.out / "depth.png", rtgs.to_bytes((depth / depth.max()).expand(3, -1, -1)))
    rtgs.write_ply(options.out / "gaussians.ply", gaussians)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
