"""A capture's pictures in fewer bytes, pixel for pixel the same: what is shipped with the project is kept small."""

from __future__ import annotations

from pathlib import Path


def shrink_pictures(folder: Path) -> int:
    """Rewrite every PNG and JPEG under ``folder`` losslessly where that makes it smaller; the bytes saved.

    PNG: better filters and compression (oxipng), text chunks stay. JPEG: progressive, optimised Huffman tables
    (mozjpeg), the coefficients stay.
    """
    import mozjpeg_lossless_optimization
    import oxipng

    saved = 0
    for path in sorted(folder.rglob("*")):
        if path.suffix not in (".png", ".jpg"):
            continue
        before = path.read_bytes()
        png = path.suffix == ".png"
        after = oxipng.optimize_from_memory(before, level=4) if png else mozjpeg_lossless_optimization.optimize(before)
        if len(after) < len(before):
            path.write_bytes(after)
            saved += len(before) - len(after)
    return saved
