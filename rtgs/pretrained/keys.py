"""The pretrained files that a step's key names: no step works with others than those.

Without torch: a plan is made of these.
"""

from __future__ import annotations

import platform
from collections.abc import Collection
from dataclasses import dataclass

from rtgs.pretrained.weights import MissingWeights, PretrainedFile, WrongWeights, find_weights, verify_weights

ABSENT = "absent"  # in a key, in the place of a file's digest: the machine that made the plan lacks it


@dataclass(frozen=True)
class Use:
    """What a step does with pretrained files, in words for errors."""

    what: str  # such as "the perceptual loss (method.loss.perceptual=0.01)"
    verb: str  # such as "train"
    done: str  # such as "trained"
    off: str  # the key and value that do without


def check_named(file: PretrainedFile, digest: str, use: Use) -> None:
    """Refuse to work without a file that the key names with this digest.

    Raises:
        MissingWeights: it is not here: the step would do without it.
        WrongWeights: the file here is not the one it should be.
    """
    try:
        verify_weights(file, find_weights(file))
    except (MissingWeights, WrongWeights) as error:
        why = str(error).rstrip(".")
        raise type(error)(
            f"the key of this step names the network {file.name} (SHA-256 {digest[:16]}...) of {use.what}, and "
            f"{_here()} cannot {use.verb} with it: {why}. Or copy it from the machine that made the plan, or set "
            f"{use.off}"
        ) from error


def check_unnamed(files: Collection[PretrainedFile], use: Use) -> None:
    """Refuse to work where all files are here and the key says that they are not.

    Raises:
        WrongWeights: they would act in what is stored as made without them.
    """
    if not files or not _all_here(files):
        return
    names = ", ".join(file.filename for file in files)
    raise WrongWeights(
        f"the key of this step names no network of {use.what}, because the machine that made the plan lacks one, but "
        f"{_here()} has {names}: what it {use.verb}s would be stored as {use.done} without. Put the files on the "
        f"machine that makes the plan, or set {use.off}; where both are one machine, the file has just arrived: repeat "
        "the command"
    )


def _here() -> str:
    return f"this machine ({platform.node()})"


def _all_here(files: Collection[PretrainedFile]) -> bool:
    try:
        for file in files:
            find_weights(file)
    except MissingWeights:
        return False
    return True
