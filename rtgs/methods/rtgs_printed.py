"""RT-GS as it is printed: the parts of :mod:`rtgs.methods.rtgs` with the paper's equations and numbers alone
(docs/paper.md).

Its numbers are in conf/method/rtgs_printed and conf/after_preset/rtgs_printed.
"""

from __future__ import annotations

from dataclasses import replace

from rtgs.methods import rtgs
from rtgs.methods.spec import BEYOND_PAPER, PROPAGATION, SABOTAGE

_HAS = rtgs.SPEC.has - {BEYOND_PAPER, PROPAGATION, SABOTAGE}  # the last two are EnvGS's, not in the paper
SPEC = replace(rtgs.SPEC, name="rtgs_printed", has=_HAS)
