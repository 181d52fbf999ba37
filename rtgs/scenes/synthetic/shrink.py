"""A capture's pictures in fewer bytes, pixel for pixel the same: what is shipped with the project is kept small."""

from __future__ import annotations

from pathlib import Path


def shrink_pictures(folder: Path) -> int:
    """Rewrite every PNG and JPEG under ``folder`` losslessly where that makes it smaller; the bytes saved.

    PNG: better filters and compression (oxipng), text chunks stay. JPEG: progressive, optimised Huffman tables
    (mozjpeg), the coefficients stay.
    """
    return sum(shrink_picture(path) for path in sorted(folder.rglob("*")))


def shrink_picture(path: Path) -> int:
    """The same for one file; one of another kind stays as it is."""
    import mozjpeg_lossless_optimization

    if path.suffix not in (".png", ".jpg"):
        return 0
    before = path.read_bytes()
    after = _smaller_png(before) if path.suffix == ".png" else mozjpeg_lossless_optimization.optimize(before)
    if len(after) >= len(before):
        return 0
    path.write_bytes(after)
    return len(before) - len(after)


def _smaller_png(data: bytes) -> bytes:
    """Channels and bits stay what readers expect: a black colour picture does not become a grey one."""
    import oxipng

    return oxipng.optimize_from_memory(
        data,
        level=4,
        bit_depth_reduction=False,
        color_type_reduction=False,
        palette_reduction=False,
        grayscale_reduction=False,
    )
