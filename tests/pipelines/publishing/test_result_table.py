"""Runs side by side as the end of a command prints them."""

from __future__ import annotations

from pipelines.publishing.results import result_table
from rtgs.evaluate.records import METRICS, EvaluationTable, RunFacts, ViewScore


def table(noise: float | None, **values: float) -> EvaluationTable:
    row = ViewScore("a.png", 64, 48, None, dict.fromkeys(METRICS) | {"psnr": 30.0} | values)
    return EvaluationTable(RunFacts("desk", "2dgs", noise_psnr=noise), (row,))


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split("  ") if cell.strip()]


def test_what_is_seen_and_the_noise_floor_stand_beside_the_mean_where_known():
    header, known, unknown = result_table([table(40.43, psnr_framed=31.25), table(None)]).splitlines()
    place = cells(header).index("PSNR")
    assert cells(header)[place : place + 4] == ["PSNR", "seen", "noise floor", "SSIM"]
    assert cells(known)[-9:-6] == ["30.00 dB", "31.25 dB", "40.43 dB"]
    assert cells(unknown)[-9:-6] == ["30.00 dB", "n/a", "n/a"]


def test_columns_that_nobody_knows_are_left_out():
    assert cells(result_table([table(None)]).splitlines()[0])[-7:-5] == ["PSNR", "SSIM"]
