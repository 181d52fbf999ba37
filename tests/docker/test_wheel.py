"""A wheel stands without the checkout: config and shipped scenes are inside, and so are all paths of the core."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import rtgs.native

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("rtgs", "pipelines", "conf", "hydra_plugins")

WITHOUT_CLONE = """import sys

# An editable install of the clone would be found before the wheel.
sys.meta_path = [finder for finder in sys.meta_path if not type(finder).__name__.startswith("ScikitBuild")]
"""


def source(folder: Path) -> Path:
    """A copy of what a wheel is made of."""
    for name in PACKAGES:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for name in ("pyproject.toml", "CMakeLists.txt", "README.md", "LICENSE"):
        shutil.copyfile(ROOT / name, folder / name)
    return folder


def wheel(folder: Path, out: Path, *words: str) -> Path:
    command = [sys.executable, "-m", "pip", "wheel", str(folder), "--no-deps", "--no-build-isolation", "-w", str(out)]
    done = subprocess.run([*command, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (found,) = out.glob("*.whl")
    return found


def installed(whl: Path, folder: Path) -> dict[str, str]:
    """The wheel unpacked, and an environment that finds it first."""
    with zipfile.ZipFile(whl) as archive:
        archive.extractall(folder)
    (folder / "sitecustomize.py").write_text(WITHOUT_CLONE)
    return {key: value for key, value in os.environ.items() if key != "RTGS_ROOT"} | {"PYTHONPATH": str(folder)}


def run(environment: dict[str, str], folder: Path, *words: str) -> str:
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_config_and_scenes_are_in_the_wheel(tmp_path):
    pytest.importorskip("scikit_build_core")
    (tmp_path / "source").mkdir()
    (tmp_path / "empty").mkdir()
    whl = wheel(source(tmp_path / "source"), tmp_path / "out", "-C", "wheel.cmake=false")
    names = zipfile.ZipFile(whl).namelist()
    for path in (*sorted((ROOT / "conf").rglob("*.yaml")), *sorted((ROOT / "rtgs" / "fetch" / "captures").iterdir())):
        assert path.relative_to(ROOT).as_posix() in names
    assert {"rtgs/py.typed", "rtgs/report/templates/report.html"} <= set(names)
    assert not [name for name in names if name.endswith((".so", ".pyc")) or name.startswith(("tests/", "lab/"))]
    environment = installed(whl, tmp_path / "site")
    core = Path(rtgs.native.core.__file__)
    shutil.copyfile(core, tmp_path / "site" / "rtgs" / "native" / core.name)  # else it would be compiled here
    where = run(environment, tmp_path / "empty", "-c", "import rtgs; print(rtgs.__file__)")
    assert where.startswith(str(tmp_path / "site"))
    planned = run(environment, tmp_path / "empty", "-m", "rtgs", "plan", "scene=demo", "method=rtgs", "preset=smoke")
    assert "train_transmittance" in planned
    scene = "rtgs.load_scene(rtgs.SceneSettings(path='embedded:toycar', long_side=32))"
    code = f"import rtgs; print(len({scene}.train))"
    assert int(run(environment, tmp_path / "empty", "-c", code)) > 10


@pytest.mark.slow
def test_a_whole_wheel_has_every_path_of_the_core(tmp_path):
    pytest.importorskip("scikit_build_core")
    (tmp_path / "source").mkdir()
    whl = wheel(source(tmp_path / "source"), tmp_path / "out")
    assert "linux" in whl.name
    environment = installed(whl, tmp_path / "site")
    code = "from rtgs.native import core; print(core.__file__, core.available_isas())"
    printed = run(environment, tmp_path, "-c", code)
    assert printed.startswith(str(tmp_path / "site"))
    assert re.findall(r"'(\w+)'", printed) == list(rtgs.native.core.available_isas())


def test_the_image_has_no_compiler_and_no_checkout():
    text = (ROOT / "docker" / "Dockerfile").read_text(encoding="utf-8")
    build, final = re.split(r"^FROM .*(?<!AS build)$", text, maxsplit=1, flags=re.MULTILINE)
    assert "g++" in build
    assert "make setup VENV=/opt/rtgs EDITABLE= " in build
    assert not re.search(r"g\+\+|gcc|make|pip|COPY \. ", final)
    (copied,) = re.findall(r"^COPY --from=build (\S+) (\S+)$", final, re.MULTILINE)
    assert copied == ("/opt/rtgs", "/opt/rtgs")  # a virtual environment works where it was made


def test_nothing_that_is_made_or_secret_reaches_the_image():
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    of_git = [line for line in (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines() if line]
    for line in of_git:
        name = line.strip("/")
        parents = {name, f"**/{name}", name.split("/")[0], *(f"{name}{end}" for end in "*")}
        assert parents & set(ignored), f".gitignore has {line}, .dockerignore has it not"
    assert "docker/.env" in ignored
    for name in (*PACKAGES, "pyproject.toml", "CMakeLists.txt", "README.md", "LICENSE"):
        assert name not in ignored
