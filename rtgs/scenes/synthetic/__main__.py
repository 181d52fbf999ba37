"""``python -m rtgs.scenes.synthetic NAME FOLDER``: path-trace a described scene into a COLMAP capture."""

from __future__ import annotations

import argparse
from dataclasses import fields, replace
from pathlib import Path

from rich.progress import Progress

from rtgs.scenes.synthetic.capture import CaptureSettings, write_capture
from rtgs.scenes.synthetic.description import list_scenes, named_scene, read_description


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m rtgs.scenes.synthetic", description=__doc__)
    parser.add_argument("scene", help=f"a TOML file, or one of: {', '.join(list_scenes())}")
    parser.add_argument("folder", type=Path, help="where the capture goes")
    for field in fields(CaptureSettings):
        kind = int if field.type == "int" else float
        if field.name == "truth":
            parser.add_argument("--no-truth", dest="truth", action="store_false")
        else:
            parser.add_argument(f"--{field.name.replace('_', '-')}", type=kind, default=field.default)
    arguments = parser.parse_args()
    description = (
        read_description(Path(arguments.scene)) if arguments.scene.endswith(".toml") else named_scene(arguments.scene)
    )
    chosen = {field.name: getattr(arguments, field.name) for field in fields(CaptureSettings)}
    with Progress() as progress:
        task = progress.add_task(description.title, total=description.viewpoints.count)
        write_capture(
            description,
            arguments.folder,
            replace(CaptureSettings(), **chosen),
            lambda name, number, count: progress.update(task, completed=number, description=name),
        )
        progress.update(task, completed=description.viewpoints.count)


if __name__ == "__main__":
    main()
