"""Captures shipped with rtgs, found by name."""

from __future__ import annotations

from pathlib import Path

from rtgs.scenes.settings import CaptureError

REACHES = ()  # the recipe of an import holds the digest of the capture


def embedded_folder() -> Path:
    """The folder that holds the embedded captures."""
    return Path(__file__).resolve().parent.parent / "data"


def embedded_names() -> tuple[str, ...]:
    """Names of the embedded captures."""
    folder = embedded_folder()
    return tuple(sorted(p.name for p in folder.iterdir() if p.is_dir())) if folder.is_dir() else ()


def embedded_capture(name: str) -> Path:
    """Folder of the embedded capture ``name``.

    Raises:
        CaptureError: there is none of that name.
    """
    names = embedded_names()
    if name not in names:
        text = f"no embedded capture {name!r}: rtgs ships {', '.join(names) or 'none'}"
        if (Path(__file__).parent.parent / "synthetic" / "scenes" / f"{name}.toml").is_file():
            text += (
                f". It is described: `rtgs run synthesize scene={name} truth=test output=captures` path-traces it "
                f"(about ten minutes on two cores), then scene=captures/{name}"
            )
        raise CaptureError(text)
    return embedded_folder() / name
