"""Plugin of pytest for ``make sanitize``: tests run on the core that ``RTGS_SANITIZED_CORE`` names, not on the
installed one."""

from __future__ import annotations

import os
import sys
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_loader

NAME = "rtgs.native._core"
VARIABLE = "RTGS_SANITIZED_CORE"

_loader = ExtensionFileLoader(NAME, os.environ[VARIABLE])
_spec = spec_from_loader(NAME, _loader)
assert _spec is not None
sys.modules[NAME] = core = module_from_spec(_spec)
_loader.exec_module(core)
assert core.sanitized, f"{os.environ[VARIABLE]} was built without sanitizers"
