"""The networks of LPIPS, and that no table has figures of others than its key names. Without torch."""

from __future__ import annotations

from collections.abc import Iterable

from rtgs.evaluate.settings import EvaluationSettings
from rtgs.pretrained.keys import ABSENT, Use, check_named, check_unnamed
from rtgs.pretrained.weights import LPIPS_VGG, VGG16

_USE = Use("LPIPS (evaluation.lpips=true)", "measure", "measured", "evaluation.lpips=false")


def check_networks(settings: EvaluationSettings, key: Iterable[tuple[str, str]]) -> None:
    """Refuse to measure with other networks on this machine than the key of the evaluation names.

    Args:
        key: (name, digest) of everything that the key names, ``ABSENT`` for the digest of a file that the machine that
            made the plan lacks. With one of the files absent there is no LPIPS.

    Raises:
        MissingWeights: the key names both files and one is not here: the table would be without LPIPS.
        WrongWeights: a file here is not the one it should be; or both are here and the key says that one is not, so
            that there would be figures in a table that is stored as one without them.
    """
    files, digests = (VGG16, LPIPS_VGG), dict(key)
    named = [digests[file.name] for file in files if file.name in digests]
    if not settings.lpips or len(named) < len(files):
        return
    if ABSENT in named:
        check_unnamed(files, _USE)
        return
    for file, digest in zip(files, named, strict=True):
        check_named(file, digest, _USE)
