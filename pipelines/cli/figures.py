"""``rtgs figures``: the paper's pictures as panels, from runs that are in the store."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from pipelines.cli.app import short
from rtgs.core.errors import RtgsError

HELP = """rtgs figures [NAME ...] [preset=quick] [group=choice] [key=value]

Panels of pictures from cached runs, as PNG and PDF in figures/<name>-<preset>: methods beside the photo, ablations,
layers. NAME is a file of conf/figure, or any YAML file like one; without a name all are drawn. Other words are as for
`rtgs run` and hold for every run of the figures. Runs that are not in the store are listed with the command that makes
them, and the exit code is 1; the other figures are drawn."""


def figures_of_words(words: Sequence[str]) -> int:
    """Draw figures; returns the exit code.

    Raises:
        RtgsError: no figure of a name, or a file that is none.
    """
    from pipelines.publishing.figures import Runs, draw_figure, figure_file, figure_names, read_figure

    names = [word for word in words if "=" not in word]
    files = [figure_file(name) for name in names or figure_names()]
    specs = {path.stem: read_figure(path) for path in files}
    runs, failed = Runs([word for word in words if "=" in word]), 0
    for name, spec in specs.items():
        try:
            for path in draw_figure(name, spec, runs):
                print(f"figure: {short(path)}")
        except RtgsError as error:
            failed += 1
            print(f"rtgs: {error}", file=sys.stderr)
    return 1 if failed else 0
