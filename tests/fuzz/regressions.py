"""Inputs that once ended in a traceback, a hang or nonsense: ``corpus/<reader>/<number>/<damaged file>``.

``python -m tests.fuzz.regressions READER NUMBER`` keeps one.
"""

from __future__ import annotations

import sys
from pathlib import Path

from tests.fuzz.readers import READERS, Files

CORPUS = Path(__file__).parent / "corpus"


def kept() -> list[tuple[str, str]]:
    """Readers and numbers of the kept inputs."""
    return sorted((folder.parent.name, folder.name) for folder in CORPUS.glob("*/*") if folder.is_dir())


def kept_input(name: str, number: str) -> tuple[Files, str]:
    """The files of a kept input, and which of them is damaged."""
    folder = CORPUS / name / number
    (path,) = (path for path in folder.rglob("*") if path.is_file())
    place = path.relative_to(folder).as_posix()
    return READERS[name].make() | {place: path.read_bytes()}, place


def keep(name: str, number: int) -> Path:
    """Write an input into the corpus."""
    from tests.fuzz.attack import case

    files, place = case(name, number)
    path = CORPUS / name / str(number) / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(files[place])
    return path


if __name__ == "__main__":
    print(keep(sys.argv[1], int(sys.argv[2])))
