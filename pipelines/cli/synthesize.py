"""``rtgs run synthesize``: described scenes become captures, each a cached step."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from pathlib import Path

from rtgs.core.errors import RtgsError

HELP = """rtgs run synthesize scene=NAME[,NAME...]|all|FILE.toml [key=value ...]

Path-traces described scenes into COLMAP captures with masks, normals and truth; needs the extra 'synthetic'.
A finished capture is kept in the store; a killed run goes on with the views it lacks.
"""


def run_synthesize(words: Sequence[str]) -> None:
    """The command line: compose, make what the store lacks, say where it is.

    Raises:
        RtgsError: no scene named, an unknown one, a value out of range.
        StepFailed: a capture could not be made.
    """
    from pipelines.steps.synthesize import synthesize_step
    from rtgs.config.synthesize import compose_synthesize
    from rtgs.scenes.synthetic.description import list_scenes, read_description
    from rtgs.workflow import InlineExecutor, Store, make_plan

    if not words or {"-h", "--help"} & set(words):
        print(f"{HELP}\nscenes: {', '.join(list_scenes())}\n\n{_keys()}")
        return
    files = scene_files([word for word in words if word.startswith("scene=")])
    config = compose_synthesize([word for word in words if not word.startswith("scene=")])
    places = {file.stem: Path(config.output) / file.stem for file in files} if config.output is not None else {}
    for place in places.values():
        _check_replaceable(place)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    steps = [synthesize_step(read_description(file), file, config.capture, config.variant) for file in files]
    store = Store(Path(config.paths.root) / "store")
    for result in InlineExecutor(store).execute(make_plan(steps, store)):
        name = result.step.params.scene
        place = places.get(name, result.folder)
        if name in places:
            export(result.folder, place)
        print(f"{name}: {place}\n  rtgs run scene.path={place}")


def scene_files(words: Sequence[str]) -> list[Path]:
    """The scene files that ``scene=`` names: names separated by commas, ``all``, or paths of TOML files.

    Raises:
        RtgsError: none, or an unknown one; lists those there are.
    """
    from rtgs.scenes.synthetic.description import SCENES, list_scenes

    known = list_scenes()
    names = [name for word in words for name in word.removeprefix("scene=").strip("'\"").split(",") if name]
    if not names:
        raise RtgsError(f"synthesize: name a scene, scene=NAME, scene=all or scene=FILE.toml; {_known(known)}")
    files = []
    for name in known if names == ["all"] else names:
        file = Path(name).expanduser() if name.endswith(".toml") else SCENES / f"{name}.toml"
        if not file.is_file():
            raise RtgsError(f"synthesize: there is no scene {name!r}; {_known(known)}, and any TOML file by its path")
        files.append(file)
    return files


def _known(names: list[str]) -> str:
    return f"rtgs describes {', '.join(names)}"


def _keys() -> str:
    from omegaconf import OmegaConf

    from rtgs.config.schema import open_schema
    from rtgs.config.synthesize import SynthesizeConfig

    return OmegaConf.to_yaml(OmegaConf.structured(open_schema(SynthesizeConfig)))


def export(artifact: Path, place: Path) -> None:
    """Copy a capture out of the store; an older synthetic capture there is replaced as a whole.

    Raises:
        RtgsError: something else is there.
        OSError: a file cannot be written (disk full); what was there stays.
    """
    from rtgs.scenes.synthetic.capture import copy_folder
    from rtgs.workflow.manifest import NAME

    _check_replaceable(place)
    place.parent.mkdir(parents=True, exist_ok=True)
    fresh = place.with_name(f"{place.name}.tmp")
    shutil.rmtree(fresh, ignore_errors=True)
    try:
        copy_folder(artifact, fresh, without=NAME)
    except OSError:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    shutil.rmtree(place, ignore_errors=True)
    fresh.rename(place)


def _check_replaceable(place: Path) -> None:
    from rtgs.scenes.synthetic.record import CAPTURE_RECORD

    if place.exists() and not (place / CAPTURE_RECORD).is_file():
        raise RtgsError(f"synthesize: {place} is there and is no synthetic capture: give another output folder")
