"""One self-contained HTML page that turns a model under the mouse: frames of an orbit, nothing beside the file."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtgs.report.figures import data_uri, image_bytes

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>
<style>
body {{ margin: 0; background: #16181c; color: #c9ced6; font: 14px system-ui, sans-serif; text-align: center }}
img {{ max-width: 100vw; max-height: 88vh; cursor: grab; user-select: none; touch-action: none }}
p {{ margin: .5em }}
</style></head><body>
<p>{title}</p>
<img id="view" draggable="false" alt="{title}, drag to turn">
<p>{note} &middot; drag, or use the arrow keys</p>
<script>
const frames = [{frames}];
const view = document.getElementById("view");
let at = 0, from = null;
const show = (index) => {{ at = (index % frames.length + frames.length) % frames.length; view.src = frames[at]; }};
view.onpointerdown = (event) => {{ from = [event.clientX, at]; view.setPointerCapture(event.pointerId); }};
view.onpointerup = () => {{ from = null; }};
view.onpointermove = (event) => {{
  if (from) show(from[1] - Math.round((event.clientX - from[0]) * frames.length / view.clientWidth));
}};
document.onkeydown = (event) => {{
  if (event.key === "ArrowLeft") show(at - 1);
  if (event.key === "ArrowRight") show(at + 1);
}};
show(0);
</script></body></html>
"""


def write_turntable(path: Path, frames: Sequence[np.ndarray], title: str, note: str, long_side: int = 800) -> int:
    """Write the page from (H, W, 3) uint8 frames in the order of turning; returns its size in bytes.

    Raises:
        ValueError: no frame.
    """
    if not frames:
        raise ValueError("a turntable needs at least one frame")
    uris = ",\n".join(f'"{data_uri(image_bytes(frame, long_side, 85))}"' for frame in frames)
    page = _PAGE.format(title=html.escape(title), note=html.escape(note), frames=uris)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
    return len(page.encode())
