"""The pretrained networks of the perceptual loss: which files it reads, and that the key of a training says so.

Without torch: a plan is made of these.
"""

from __future__ import annotations

from collections.abc import Iterable

from rtgs.pretrained.keys import Use, check_named, check_unnamed
from rtgs.pretrained.weights import LPIPS_VGG, VGG16, PretrainedFile
from rtgs.train.settings import LossSettings

Named = tuple[tuple[str, str], ...]  # (name, SHA-256) of pretrained files


def networks_of(loss: LossSettings) -> tuple[PretrainedFile, ...]:
    """The files that the form of the perceptual loss reads; none where the loss is off."""
    if loss.perceptual == 0:
        return ()
    return (VGG16,) if loss.perceptual_form == "vgg16_l1" else (VGG16, LPIPS_VGG)


def named_in_key(loss: LossSettings, present: Iterable[tuple[str, str]]) -> Named:
    """Of the files that are ``present``, those that the key of a training names: all that the loss reads.

    None where one of them is absent: then it trains without the loss, as where there is none of them.
    """
    wanted = {file.name for file in networks_of(loss)}
    found = tuple(each for each in present if each[0] in wanted)
    return found if len(found) == len(wanted) else ()


def check_networks(loss: LossSettings, key: Iterable[tuple[str, str]]) -> None:
    """Refuse to train with other networks on this machine than the key of the training names.

    Args:
        key: (name, digest) of everything that the key names; what is no network of the loss is passed over.

    Raises:
        MissingWeights: the key names a file that is not here: the loss would be left out.
        WrongWeights: a file here is not the one it should be; or all are here and the key names none, so that the loss
            would act in a training that is stored as one without it.
    """
    files, named = networks_of(loss), dict(key)
    what = f"the perceptual loss (method.loss.perceptual={loss.perceptual:g}, perceptual_form={loss.perceptual_form})"
    use = Use(what, "train", "trained", "method.loss.perceptual=0")
    for file in files:
        if file.name in named:
            check_named(file, named[file.name], use)
    if not any(file.name in named for file in files):
        check_unnamed(files, use)
