"""A paper's table as Markdown, CSV, LaTeX and HTML.

The paper's own figures and the differences to them stand in columns of their own, which exist only where the data are
the paper's: beside stand-ins they would invite a comparison that means nothing.
"""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

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
        temporary = path.with_suffix(f".{suffix}.tmp")
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
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
    if any(cell.paper is not None for cell in cells) and presets != [PAPER_PRESET]:
        found.append(
            f"The paper's figures are those of its whole schedule (preset {PAPER_PRESET}): differences of preset "
            f"{', '.join(presets)} to them are no verdict."
        )
    if table.spec.data == STAND_IN:
        found.append(
            "The scenes are path-traced stand-ins named after the paper's: its figures are for other data and not "
            "comparable, so they are not shown."
        )
    if max(seeds) > 1:
        fewer = f" ({seeds[0]} where runs are missing)" if len(seeds) > 1 else ""
        found.append(f"Mean ± sample standard deviation over {max(seeds)} seeds{fewer}; smaller differences are noise.")
    else:
        found.append("One seed: the spread is not known; differences of a few tenths of a dB may be noise.")
    if len(cells) < len(table.methods) * len(table.scenes):
        found.append("Empty cells: the run failed, or was not asked for.")
    absent = [metric.title for metric in QUALITY if all(cell.values[metric.key] is None for cell in cells)]
    if absent:
        found.append(f"{', '.join(absent)}: not measured (`rtgs weights` says what is missing).")
    return tuple(found)


def _rows(
    table: PaperTable, metrics: Iterable[Metric], marks: Mapping[int, tuple[str, str]], pm: str
) -> list[list[str]]:
    """One row per method: the metrics of every scene."""
    metrics = tuple(metrics)
    rows = []
    for method in table.methods:
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


def _paper_rows(table: PaperTable) -> list[list[str]]:
    """The paper's figures and ours minus theirs; none where the data are not the paper's."""
    rows = []
    for method in table.methods:
        cells = [table.cell(method, scene) for scene in table.scenes]
        if not any(cell is not None and cell.paper is not None for cell in cells):
            continue
        row = [method]
        for cell in cells:
            paper = None if cell is None else cell.paper
            row.append("" if paper is None else f"{paper.psnr:.2f} / {paper.ssim:.3f} / {paper.lpips:.3f}")
            row.append("" if cell is None or paper is None else _difference(cell))
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
    header = ["method"]
    for scene in table.scenes:
        header += [f"{scene}: paper's PSNR / SSIM / LPIPS", f"{scene}: ours - paper's"]
    return header


def _header(table: PaperTable, metrics: Iterable[Metric]) -> list[str]:
    arrows = {True: " ↑", False: " ↓", None: ""}
    return ["method"] + [f"{s} {m.title}{arrows[m.higher_is_better]}" for s in table.scenes for m in metrics]


def _blocks(
    table: PaperTable, marks: Mapping[int, tuple[str, str]], pm: str
) -> list[tuple[str, list[str], list[list[str]]]]:
    """(heading, header, rows) of every part of the table."""
    blocks = [("", _header(table, QUALITY), _rows(table, QUALITY, marks, pm))]
    parts = {"Inside the mask, and what it cost": (*COSTS, *MESH), "Against the truth of path-traced scenes": TRUTH}
    for heading, metrics in parts.items():
        known = [m for m in metrics if any(cell.values[m.key] is not None for cell in table.cells.values())]
        blocks += [(heading, _header(table, known), _rows(table, known, marks, pm))] if known else []
    if paper := _paper_rows(table):
        blocks.append(("The paper's figures", _paper_header(table), paper))
    return blocks


# ---- formats -------------------------------------------------------------------------------------------------------

_MARKDOWN = {1: ("**", "**"), 2: ("<u>", "</u>"), 3: ("*", "*")}
_LATEX = {1: (r"\textbf{", "}"), 2: (r"\underline{", "}"), 3: (r"\textit{", "}")}
_HTML = {1: ("<b class=first>", "</b>"), 2: ("<b class=second>", "</b>"), 3: ("<b class=third>", "</b>")}
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


_PAPER_COLUMNS = ("paper_psnr", "paper_ssim", "paper_lpips")
_PAPER_COLUMNS += ("psnr_minus_paper", "ssim_minus_paper", "lpips_minus_paper")


def comma_separated(table: PaperTable) -> str:
    """One row per method and scene with everything, unrounded: for other programs."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    head = ["table", "data", "scene", "method", "preset", "resolution", "views", "seeds"]
    head += [f"{m.key}{part}" for m in ALL for part in ("", "_std", "_rank")]
    writer.writerow([*head, *(_PAPER_COLUMNS if table.spec.data == PAPER_DATA else ())])
    for scene in table.scenes:
        for method in table.methods:
            if cell := table.cell(method, scene):
                writer.writerow(map(spreadsheet_cell, _csv_row(table.spec, cell, ALL)))
    return stream.getvalue()


def _csv_row(spec: TableSpec, cell: Cell, metrics: Sequence[Metric]) -> list[object]:
    row: list[object] = [spec.name, spec.data, cell.scene, cell.method, cell.preset, cell.resolution, cell.views]
    row.append(" ".join(map(str, cell.seeds)))
    for metric in metrics:
        value = cell.values[metric.key]
        row += ["", ""] if value is None else [repr(value.mean), "" if value.spread is None else repr(value.spread)]
        row.append(cell.ranks.get(metric.key, ""))
    if spec.data != PAPER_DATA:
        return row
    paper = cell.paper
    row += ["", "", ""] if paper is None else [paper.psnr, paper.ssim, paper.lpips]
    return row + ["" if value is None else repr(value) for value in _differences(cell)]


def latex(table: PaperTable) -> str:
    """A ``table*`` environment; needs the package booktabs."""
    caption = " ".join([f"{table.spec.title}.", _LEGEND.format("bold, underlined, italic"), *notes(table)])
    lines = [r"\begin{table*}", r"\centering", rf"\caption{{{_tex(caption)}}}"]
    for _, header, rows in _blocks(table, _LATEX, r" $\pm$ "):
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
