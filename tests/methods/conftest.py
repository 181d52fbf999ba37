"""Tests of methods share the small scene with the tests of training, the tiny network with those of evaluation."""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / name) for name in ("train", "evaluate")]
