"""``rtgs get NAME``: a public capture, brought to this machine; without a name: what there is."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.errors import RtgsError

if TYPE_CHECKING:
    from rtgs.fetch.catalogue import Capture

HELP = """rtgs get                     what there is, how large, under which licence
rtgs get NAME [to=FOLDER]    bring it to FOLDER/NAME (default: DATA_ROOT, or data)

A download that was stopped goes on with the same command. Digests (SHA-256) are compared where they are known;
where nobody published one, that of the first download is recorded."""


def get(words: Sequence[str]) -> int:
    """The command; returns the exit code.

    Raises:
        RtgsError: no such capture or word, or it cannot be brought.
    """
    from rtgs.fetch.catalogue import find_capture
    from rtgs.fetch.get import get_capture

    if any(word in ("-h", "--help", "help") for word in words):
        print(HELP)
        return 0
    names = [word for word in words if "=" not in word]
    root = _root([word for word in words if "=" in word])
    if not names:
        _list()
        return 0
    for capture in [find_capture(name) for name in names]:
        _announce(capture)
        folder = get_capture(capture, root, lambda line: print(line, flush=True))
        print(f"{folder}\n  {_next(capture.name, folder, root)}")
    return 0


def _root(words: Sequence[str]) -> Path:
    root = Path(os.environ.get("DATA_ROOT", "data"))
    for word in words:
        key, _, value = word.partition("=")
        if key != "to" or not value:
            raise RtgsError(f"rtgs get: {word!r} is not understood\n\n{HELP}")
        root = Path(value).expanduser()
    return root


def _announce(capture: Capture) -> None:
    size = "" if capture.size is None else f", {capture.size / 1e6:,.0f} MB"
    print(f"{capture.name}: {capture.title}{size}\n  licence: {capture.licence}\n  from {capture.page}", flush=True)


def _list() -> None:
    from rtgs.fetch.catalogue import capture_names, find_capture

    for name in capture_names():
        capture = find_capture(name)
        _announce(capture)
        if capture.by_hand:
            print(f"  to be fetched by hand: `rtgs get {name}` says how")


def _next(name: str, folder: Path, root: Path) -> str:
    """What to call with it."""
    if (folder / "sedan").is_dir():
        return f"DATA_ROOT={root} rtgs check data={name}"
    return f"rtgs run scene={folder} method=3dgs preset=quick"
