"""The report as a browser draws it, wide and on a phone: nothing clipped, rows filled, tables that show they scroll."""

from __future__ import annotations

import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rtgs.report.figures import Curve
from rtgs.report.files import link_files
from rtgs.report.page import write_report
from tests.report.test_page import full_data
from tests.view.chromium import browser

CHROMIUM = browser()
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
PROBE = """<script>
const told = {};
const inside = (node) => node.scrollWidth <= node.clientWidth + 1;
told.page = document.documentElement.scrollWidth <= window.innerWidth;
told.tiles = [...document.querySelectorAll(".tile, .tile *")].filter((node) => !inside(node)).map((n) => n.textContent);
const tiles = [...document.querySelectorAll(".tile")].map((node) => node.getBoundingClientRect());
const right = document.querySelector(".tiles").getBoundingClientRect().right;
const rows = {};
for (const tile of tiles) rows[Math.round(tile.top)] = Math.max(rows[Math.round(tile.top)] || 0, tile.right);
told.gaps = Object.values(rows).map((end) => Math.round(right - end));
told.scrolls = [...document.querySelectorAll(".scroll")].filter((node) => !inside(node))
  .map((n) => [n.tabIndex, n.getAttribute("role"), getComputedStyle(n).backgroundImage.includes("gradient")]);
told.texts = [...document.querySelectorAll(".chart svg")].map((svg) => {
  const written = [...svg.querySelectorAll("text")].filter((n) => n.textContent.trim());
  const boxes = written.map((n) => n.getBoundingClientRect());
  let meet = 0;
  boxes.forEach((a, i) => boxes.slice(i + 1).forEach((b) => {
    if (a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 2 && b.top < a.bottom - 2) meet += 1;
  }));
  return meet;
});
const button = document.querySelectorAll(".enlarge")[0];
button.click();
const first = [document.querySelector("#lightbox img").alt, document.querySelector("#lightbox p").textContent];
document.querySelector("#lightbox").dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
told.lightbox = [...first, document.querySelector("#lightbox img").alt];
told.dark = matchMedia("(prefers-color-scheme: dark)").matches;
told.ground = getComputedStyle(document.body).backgroundColor;
document.querySelector("#lightbox").close();
document.documentElement.dataset.told = JSON.stringify(told);
</script></body>"""


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """A report with long numbers, many curves and a wide table."""
    data = full_data()
    facts = replace(data.evaluation.facts, train_seconds=244.0, surfels=1_234_567)
    steps = tuple(range(0, 2000, 100))
    names = ("loss", "l1", "dssim", "normal", "distortion", "specular", "transmittance depth", "object guide")
    losses = tuple(
        Curve(f"train/{name}", steps, tuple(10.0 ** (-k) / (1 + step / 50) for step in steps))
        for k, name in enumerate(names)
    )
    data = replace(data, evaluation=replace(data.evaluation, facts=facts), curves=(*losses, *data.curves[1:]))
    folder = tmp_path_factory.mktemp("run")
    (folder / "point_cloud.ply").write_bytes(b"ply")
    write_report(folder / "report.html", data)
    link_files(folder / "report.html")
    return folder / "report.html"


def chromium(folder: Path, *words: str) -> str:
    assert CHROMIUM is not None
    common = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={folder}"]
    return subprocess.run([*common, *words], capture_output=True, text=True, timeout=240, check=True).stdout


def probed(page: Path, folder: Path, width: int, *words: str) -> dict:
    """What the script above finds, with the page in a frame of this width: windows have a least width of their own."""
    copy, outer = folder / "probed.html", folder / "outer.html"
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", PROBE), encoding="utf-8")
    outer.write_text(
        f'<iframe src="probed.html" style="width:{width}px;height:2000px;border:0"></iframe><pre></pre><script>'
        'onload = () => { document.querySelector("pre").textContent = '
        'document.querySelector("iframe").contentDocument.documentElement.dataset.told; };</script>',
        encoding="utf-8",
    )
    words = ("--allow-file-access-from-files", "--virtual-time-budget=3000", *words)
    dumped = chromium(folder / "profile", *words, "--window-size=1600,2200", "--dump-dom", outer.as_uri())
    found = re.search(r"<pre>(.+?)</pre>", dumped, re.DOTALL)
    assert found is not None
    return json.loads(found[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&"))


@pytest.mark.parametrize("width", [1400, 420])
def test_nothing_is_clipped_and_every_row_is_full(page, tmp_path, width):
    told = probed(page, tmp_path, width)
    assert told["page"]
    assert told["tiles"] == []
    assert all(gap <= 2 for gap in told["gaps"])
    assert told["texts"] == [0, 0, 0]
    assert all(each == [0, "region", True] for each in told["scrolls"])
    assert told["scrolls"] or width == 1400
    alt, caption, following = told["lightbox"]
    assert alt == "Error of view_0.jpg"
    assert caption == "view_0.jpg: Error, 0 to ≥ 0.2. mean over RGB of |render − photo|"
    assert following == "FLIP of view_0.jpg"
    assert not told["dark"]


def test_the_page_is_dark_where_the_reader_wants_it(page, tmp_path):
    told = probed(page, tmp_path, 1400, "--force-dark-mode", "--blink-settings=preferredColorScheme=0")
    assert told["dark"]
    assert told["ground"] == "rgb(19, 20, 22)"


@pytest.mark.parametrize("width", [1400, 420])
def test_a_screenshot_shows_the_page(page, tmp_path, width):
    target = tmp_path / f"{width}.png"
    words = (f"--screenshot={target}", f"--window-size={width},1600", page.as_uri())
    chromium(tmp_path / "profile", *words)
    pixels = np.asarray(Image.open(target).convert("RGB"))
    assert pixels.shape[1] == width
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 200  # text, tiles and pictures, no empty page
