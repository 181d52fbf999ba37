"""Hydra's and OmegaConf's complaints as one message: what, in which file or override, which key, and what to write."""

from __future__ import annotations

import dataclasses
import difflib
import re
import typing

from hydra.errors import OverrideParseException

from rtgs.config.keys import config_keys
from rtgs.config.locate import choices_of
from rtgs.config.synthesize import SynthesizeConfig


def explain(error: BaseException) -> str:
    """One message for a config that does not compose."""
    if isinstance(error, OverrideParseException):
        grammar = (str(error).splitlines() or [""])[0]
        return f"{error.override!r} is not a legal override ({grammar}); put a value with special characters in quotes"
    cause = error.__cause__
    first = str(error).splitlines()[0] if str(error) else type(error).__name__
    text = str(error) if cause is None else f"{first}\n{cause}"
    text = re.sub(r"\nConfig search path:.*", "", text, flags=re.DOTALL)
    text = re.sub(r"\n\s*(reference_type|object_type)=.*", "", text)
    text = re.sub(r"\nTo append to your config use .*", "", text)
    text = re.sub(r"\n\s*full_key: (\S+)", r" (\1)", text)
    text = re.sub(r"\n\s*full_key: ?", "", text)
    if match := re.search(r"Could not find '(\w+)/([^']*)'", text):
        text += _advice_for_choice(*match.groups())
    match = re.search(r"Key '([^']+)' (?:is )?not in", text)
    if match:
        close = close_keys(match.group(1))
        text += f"\nDid you mean {' or '.join(close)}?" if close else "\n`rtgs explain` lists all keys."
    return text


def close_keys(name: str) -> list[str]:
    """Keys and groups of keys that somebody may mean who writes ``name``, the likeliest first, three at most."""
    if name in _ELSEWHERE:
        return [_ELSEWHERE[name]]
    places = [
        *config_keys(),
        *{key.rpartition(".")[0] for key in config_keys() if "." in key},
        *all_keys(SynthesizeConfig),
    ]
    last = {}
    for place in sorted(set(places), key=lambda place: (place.count("."), place)):
        last.setdefault(place.rpartition(".")[2], []).append(place)
    if name in last:
        return last[name][:3]
    close = difflib.get_close_matches(name, sorted(last), n=3)
    return [place for word in close for place in last[word]][:3]


_ELSEWHERE = {
    **dict.fromkeys(("iterations", "iters", "steps", "max_steps", "max_num_iterations", "epochs"), "schedule.total"),
    **dict.fromkeys(("data", "source_path", "path", "input", "dataset"), "scene.path"),
    **dict.fromkeys(("resolution", "size", "width", "downscale_factor"), "scene.long_side"),
    **dict.fromkeys(("lambda_dssim", "ssim_lambda"), "method.loss.dssim"),
    **dict.fromkeys(("output", "output_dir", "model_path"), "paths.root"),
    **dict.fromkeys(("workers", "num_workers", "jobs"), "hydra.launcher.workers"),
    **dict.fromkeys(("cap_max", "max_gaussians", "num_gaussians"), "method.density.max_surfels"),
    "sh_degree": "method.init.sh_degree",
    "test_every": "scene.split_every",
    "llffhold": "scene.split_every",
}
"""Keys of ours by the words of other programs: 3DGS, nerfstudio, gsplat."""


def explain_yaml(error: BaseException) -> str:
    """One message for a file that is no YAML; the parser names file, line and column."""
    return f"a config file is no valid YAML: {' '.join(str(error).split())}; correct it there"


def _advice_for_choice(group: str, name: str) -> str:
    close = difflib.get_close_matches(name, choices_of(group), n=3)
    advice = f"\nDid you mean {' or '.join(close)}?" if close else ""
    return advice + ("\nA folder works as well: scene=/path/to/capture" if group == "scene" else "")


def all_keys(cls: type) -> set[str]:
    """Every field name in a dataclass tree."""
    names: set[str] = set()
    for name, hint in typing.get_type_hints(cls).items():
        names.add(name)
        if dataclasses.is_dataclass(hint):
            names |= all_keys(typing.cast(type, hint))
    return names
