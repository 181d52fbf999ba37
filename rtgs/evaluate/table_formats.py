"""A paper's table as Markdown, CSV, LaTeX and HTML.

The paper's own figures stand in columns of their own, marked as published on the papers' data. Differences to them are
formed only where the data are the paper's: beside stand-ins they would mean nothing.
"""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from rtgs.core.files import whole_file
from rtgs.core.listing import spreadsheet_cell
from rtgs.evaluate.publish import (
    ALL,
    COSTS,
    MESH,
    PAPER_DATA,
    PAPER_PRESET,
    QUALITY,
    STAND_IN,
    TRUTH,
    Cell,
    Metric,
    PaperTable,
    TableSpec,
    Value,
)
from rtgs.evaluate.tables import NOT_AVAILABLE


def write_table(folder: Path, table: PaperTable) -> tuple[Path, ...]:
    """Write ``table.md``, ``table.csv``, ``table.tex`` and ``table.html``; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for suffix, text in (
        ("md", markdown(table)),
        ("csv", comma_separated(table)),
        ("tex", latex(table)),
        ("html", page(table)),
    ):
        path = folder / f"table.{suffix}"
        with whole_file(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        written.append(path)
    return tuple(written)


def _shown(value: Value | None, digits: int, plus_minus: str = " ± ") -> str:
    if value is None:
        return NOT_AVAILABLE
    spread = "" if value.spread is None else f"{plus_minus}{value.spread:.{digits}f}"
    return f"{value.mean:.{digits}f}{spread}"


def _marked(text: str, rank: int | None, marks: Mapping[int, tuple[str, str]]) -> str:
    before, after = marks.get(rank or 0, ("", ""))
    return f"{before}{text}{after}"


def notes(table: PaperTable) -> tuple[str, ...]:
    """What a reader must know, one sentence each."""
    cells = list(table.cells.values())
    sizes = dict.fromkeys(f"{cell.scene} {cell.resolution}, {cell.views} test views" for cell in cells)
    presets = sorted({cell.preset for cell in cells})
    seeds = sorted({len(cell.seeds) for cell in cells})
    found = [f"Preset {', '.join(presets)}; {'; '.join(sizes)}."]
    if any(cell.paper is not None for cell in cells):
        found += _against_paper(table)
    if table.spec.data == STAND_IN:
        found.append(
            "The scenes are path-traced stand-ins named after the paper's: its figures are for other data and not "
            "comparable, so no differences are formed."
        )
    if any(row not in table.methods for row, _ in table.published):
        found.append("Rows that have published figures alone were not run here.")
    if max(seeds) > 1:
        fewer = f" ({seeds[0]} where runs are missing)" if len(seeds) > 1 else ""
        found.append(f"Mean ± sample standard deviation over {max(seeds)} seeds{fewer}; smaller differences are noise.")
    else:
        found.append("One seed: the spread is not known; differences of a few tenths of a dB may be noise.")
    if len(cells) < len(table.methods) * len(table.scenes):
        found.append("Empty cells: the run failed, or was not asked for.")
    for metric in QUALITY:
        if all(cell.values[metric.key] is None for cell in cells):
            why = "`rtgs weights` says what is missing" if metric.key.startswith("lpips") else "by an older version"
            found.append(f"{metric.title}: not measured ({why}).")
    return tuple(found)


def _against_paper(table: PaperTable) -> list[str]:
    """Every way in which the runs differ from what the paper describes: what all have in common, then row by row; of
    the rows beside which its figures stand."""
    ways = {
        method: tuple(dict.fromkeys(way for scene in table.scenes for way in _differs(table, method, scene)))
        for method in table.methods
        if any(cell.paper is not None for cell in table.cells.values() if cell.method == method)
    }
    common = [way for way in next(iter(ways.values())) if all(way in others for others in ways.values())]
    found = []
    presets = sorted({cell.preset for cell in table.cells.values()})
    if presets != [PAPER_PRESET]:
        found.append(
            f"The paper's figures are those of its whole schedule (preset {PAPER_PRESET}): differences of preset "
            f"{', '.join(presets)} to them are no verdict."
        )
    if common:
        found.append(f"All runs differ from the paper: {'; '.join(common)}.")
    for method, own in ways.items():
        rest = [way for way in own if way not in common]
        if rest:
            found.append(f"{method} {'also ' if common else ''}differs from the paper: {'; '.join(rest)}.")
    return found


def _differs(table: PaperTable, method: str, scene: str) -> tuple[str, ...]:
    cell = table.cell(method, scene)
    return () if cell is None else cell.differs


def _rows(
    table: PaperTable,
    methods: Sequence[str],
    metrics: Iterable[Metric],
    marks: Mapping[int, tuple[str, str]],
    pm: str,
) -> list[list[str]]:
    """One row per method: the metrics of every scene."""
    metrics = tuple(metrics)
    rows = []
    for method in methods:
        row = [method]
        for scene in table.scenes:
            cell = table.cell(method, scene)
            for metric in metrics:
                if cell is None:
                    row.append("")
                else:
                    text = _shown(cell.values[metric.key], metric.digits, pm)
                    row.append(_marked(text, cell.ranks.get(metric.key), marks))
        rows.append(row)
    return rows


def _published(table: PaperTable, method: str) -> list[str]:
    """The paper's figures of a row, a cell for each scene that it has; they are on its own data."""
    scores = [table.published.get((method, scene)) for scene in _published_scenes(table)]
    return ["" if paper is None else f"{paper.psnr:.2f} / {paper.ssim:.3f} / {paper.lpips:.3f}" for paper in scores]


def _published_scenes(table: PaperTable) -> list[str]:
    return [scene for scene in table.scenes if any(scene == other for _, other in table.published)]


def _paper_rows(table: PaperTable) -> list[list[str]]:
    """Ours minus the paper's figures; none where the data are not the paper's."""
    rows = []
    for method in table.methods:
        cells = [table.cell(method, scene) for scene in table.scenes]
        if not any(cell is not None and cell.paper is not None for cell in cells):
            continue
        row = [method]
        for cell in cells:
            row.append("" if cell is None or cell.paper is None else _difference(cell))
        rows.append(row)
    return rows


def _differences(cell: Cell) -> list[float | None]:
    """Ours minus the paper's PSNR, SSIM and LPIPS; None where one of them is not there."""
    paper = cell.paper
    theirs = (None, None, None) if paper is None else (paper.psnr, paper.ssim, paper.lpips)
    ours = [cell.values[metric.key] for metric in QUALITY]
    return [None if value is None or other is None else value.mean - other for value, other in zip(ours, theirs)]


def _difference(cell: Cell) -> str:
    found = zip(_differences(cell), QUALITY)
    return " / ".join(NOT_AVAILABLE if value is None else f"{value:+.{metric.digits}f}" for value, metric in found)


def _paper_header(table: PaperTable) -> list[str]:
    return ["method", *(f"{scene}: ours - paper's PSNR / SSIM / LPIPS" for scene in table.scenes)]


def _header(table: PaperTable, metrics: Iterable[Metric]) -> list[str]:
    arrows = {True: " ↑", False: " ↓", None: ""}
    return ["method"] + [f"{s} {m.title}{arrows[m.higher_is_better]}" for s in table.scenes for m in metrics]


def _blocks(
    table: PaperTable, marks: Mapping[int, tuple[str, str]], pm: str
) -> list[tuple[str, list[str], list[list[str]]]]:
    """(heading, header, rows) of every part of the table."""
    parts = {
        "": QUALITY,
        "Inside the mask, and what it cost": (*COSTS, *MESH),
        "Against the truth of path-traced scenes": TRUTH,
    }
    blocks = []
    for part, metrics in parts.items():
        values = [cell.values for cell in table.cells.values()]
        known = [m for m in metrics if not part or any(each[m.key] is not None for each in values)]
        for block, methods in (table.blocks if part else table.blocks_with_published) if known else ():
            heading = ": ".join(text for text in (block, part) if text)
            header, rows = _header(table, known), _rows(table, methods, known, marks, pm)
            if not part:
                header += [f"{table.paper_scenes[scene]} {_PUBLISHED}" for scene in _published_scenes(table)]
                rows = [[*row, *_published(table, method)] for row, method in zip(rows, methods, strict=True)]
            blocks.append((heading, header, rows))
    if paper := _paper_rows(table):
        blocks.append(("Against the paper's figures", _paper_header(table), paper))
    return blocks


# ---- formats -------------------------------------------------------------------------------------------------------

_MARKDOWN = {1: ("**", "**"), 2: ("<u>", "</u>"), 3: ("*", "*")}
_LATEX = {1: (r"\textbf{", "}"), 2: (r"\underline{", "}"), 3: (r"\textit{", "}")}
_HTML = {1: ("<b class=first>", "</b>"), 2: ("<b class=second>", "</b>"), 3: ("<b class=third>", "</b>")}
_PUBLISHED = "published, on the papers' data: PSNR / SSIM / LPIPS"  # behind the paper's name of the scene
_LEGEND = "First, second and third of each column are marked {}."


def markdown(table: PaperTable) -> str:
    """GitHub Markdown."""
    lines = [f"# {table.spec.title}", ""]
    for heading, header, rows in _blocks(table, _MARKDOWN, " ± "):
        lines += [f"## {heading}", ""] if heading else []
        lines.append("| " + " | ".join(_escaped_pipe(cell) for cell in header) + " |")
        lines.append("|" + "---|" * len(header))
        lines += ["| " + " | ".join(_escaped_pipe(cell) for cell in row) + " |" for row in rows]
        lines.append("")
    lines += [f"- {note}" for note in (_LEGEND.format("**bold**, <u>underlined</u>, *italic*"), *notes(table))]
    return "\n".join(lines) + "\n"


def _escaped_pipe(text: str) -> str:
    return text.replace("|", "\\|")


# The paper has the first three of QUALITY; on its own data, "paper_", differences are formed.
_PUBLISHED_COLUMNS = ("published_psnr", "published_ssim", "published_lpips")
_PAPER_COLUMNS = ("paper_psnr", "paper_ssim", "paper_lpips")
_DIFFERENCE_COLUMNS = ("psnr_minus_paper", "ssim_minus_paper", "lpips_minus_paper")


def comma_separated(table: PaperTable) -> str:
    """One row per method and scene with everything, unrounded: for other programs. Rows that were not run last."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    head = ["table", "data", "scene", "method", "preset", "resolution", "views", "seeds"]
    head += [f"{m.key}{part}" for m in ALL for part in ("", "_std", "_rank")]
    ours = table.spec.data == PAPER_DATA
    added = (*_PAPER_COLUMNS, *_DIFFERENCE_COLUMNS) if ours else _PUBLISHED_COLUMNS if table.published else ()
    writer.writerow([*head, *added])
    for scene in table.scenes:
        for method in table.methods:
            if cell := table.cell(method, scene):
                row = [*_csv_row(table.spec, cell, ALL), *_csv_published(table, method, scene)[: len(added)]]
                writer.writerow(map(spreadsheet_cell, [*row, *(_csv_differences(cell) if ours else ())]))
    for row, scene in table.published:
        if row not in table.methods:
            start: list[object] = [table.spec.name, table.spec.data, scene, row]
            blank = [""] * (len(head) - len(start))
            rest = [""] * (len(added) - len(_PUBLISHED_COLUMNS))
            writer.writerow(map(spreadsheet_cell, [*start, *blank, *_csv_published(table, row, scene), *rest]))
    return stream.getvalue()


def _csv_published(table: PaperTable, method: str, scene: str) -> list[object]:
    paper = table.published.get((method, scene))
    return ["", "", ""] if paper is None else [paper.psnr, paper.ssim, paper.lpips]


def _csv_differences(cell: Cell) -> list[object]:
    return ["" if value is None else repr(value) for value in _differences(cell)]


def _csv_row(spec: TableSpec, cell: Cell, metrics: Sequence[Metric]) -> list[object]:
    row: list[object] = [spec.name, spec.data, cell.scene, cell.method, cell.preset, cell.resolution, cell.views]
    row.append(" ".join(map(str, cell.seeds)))
    for metric in metrics:
        value = cell.values[metric.key]
        row += ["", ""] if value is None else [repr(value.mean), "" if value.spread is None else repr(value.spread)]
        row.append(cell.ranks.get(metric.key, ""))
    return row


def latex(table: PaperTable) -> str:
    """A ``table*`` environment; needs the package booktabs."""
    caption = " ".join([f"{table.spec.title}.", _LEGEND.format("bold, underlined, italic"), *notes(table)])
    lines = [r"\begin{table*}", r"\centering", rf"\caption{{{_tex(caption)}}}"]
    for heading, header, rows in _blocks(table, _LATEX, r" $\pm$ "):
        lines += [rf"\par\smallskip\emph{{{_tex(heading)}}}\par"] if heading else []
        lines += [rf"\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}", r"\toprule"]
        lines.append(" & ".join(_tex(cell) for cell in header) + r" \\")
        lines.append(r"\midrule")
        lines += [" & ".join([_tex(row[0]), *(_tex_figures(cell) for cell in row[1:])]) + r" \\" for row in rows]
        lines += [r"\bottomrule", r"\end{tabular}", ""]
    return "\n".join([*lines, r"\end{table*}"]) + "\n"


_TEX = str.maketrans({
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "`": "'", "\n": " ", "\r": " ",
})  # fmt: skip


def _tex(text: str) -> str:
    text = text.translate(_TEX)
    return text.replace("↑", r"$\uparrow$").replace("↓", r"$\downarrow$").replace("±", r"$\pm$")


def _tex_figures(text: str) -> str:
    return text.replace("±", r"$\pm$")  # figures and our own commands: nothing to escape


_STYLE = (
    "body{font:14px/1.5 system-ui,sans-serif;margin:2em;max-width:100em}table{border-collapse:collapse;margin:1em 0}"
    "th,td{padding:.3em .7em;text-align:right;border-bottom:1px solid #ddd}th{border-bottom:2px solid #888}"
    "th:first-child,td:first-child{text-align:left}.first{background:#ffd6a5}.second{background:#fdffb6}"
    ".third{background:#e8f5d0}b{font-weight:600;padding:.1em .3em;border-radius:.2em}"
)


def page(table: PaperTable) -> str:
    """A self-contained HTML page."""
    title = html.escape(table.spec.title)
    parts = [f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title><style>{_STYLE}</style>"]
    parts.append(f"<h1>{title}</h1>")
    for heading, header, rows in _blocks(table, _HTML, " ± "):
        parts.append(f"<h2>{html.escape(heading)}</h2>" if heading else "")
        parts.append("<table><thead><tr>" + "".join(f"<th>{html.escape(cell)}" for cell in header) + "</thead><tbody>")
        parts += [f"<tr><td>{html.escape(row[0])}" + "".join(f"<td>{cell}" for cell in row[1:]) for row in rows]
        parts.append("</tbody></table>")
    legend = _LEGEND.format("<b class=first>so</b>, <b class=second>so</b>, <b class=third>so</b>")
    parts.append(f"<ul><li>{legend}" + "".join(f"<li>{html.escape(note)}" for note in notes(table)) + "</ul></html>")
    return "\n".join(part for part in parts if part) + "\n"
