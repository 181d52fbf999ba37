"""Hydra's and OmegaConf's complaints as one message: what, in which file or override, which key, and what to write."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection

from hydra.errors import OverrideParseException

from rtgs.config.keys import config_keys, keys_of
from rtgs.config.locate import choices_of
from rtgs.config.synthesize import SYNTHESIZE_NOTE, SynthesizeConfig


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
        of_synthesize = SYNTHESIZE_NOTE in getattr(error, "__notes__", ())
        known = keys_of(SynthesizeConfig()) if of_synthesize else None
        close = close_keys(match[1], known)
        listed = "`rtgs explain` lists all keys." if known is None else "`rtgs run synthesize --help` lists its keys."
        text += f"\nDid you mean {' or '.join(close)}?" if close else f"\n{listed}"
    return text


def close_keys(name: str, known: Collection[str] | None = None) -> list[str]:
    """Keys and groups of keys that somebody may mean who writes ``name``, the likeliest first, three at most.

    Args:
        known: dotted keys of the command in question. None: those of a run.
    """
    elsewhere = _ELSEWHERE.get(name)
    if elsewhere and (known is None or elsewhere in known):
        return [elsewhere]
    keys = config_keys() if known is None else known
    places = [*keys, *{key.rpartition(".")[0] for key in keys if "." in key}]
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
