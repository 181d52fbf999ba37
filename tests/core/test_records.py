"""Files that are one dataclass: round trips, and what a damaged one says."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.core.records import read_json, read_record, write_json

REMEDY = "make it again"


@dataclass(frozen=True)
class Note:
    """A record with every kind of field that records have."""

    count: int
    share: float
    flat: bool
    title: str | None = None
    scores: dict[str, float] | None = None
    decisions: tuple[Decision, ...] = ()


def written(folder: Path, text: str) -> Path:
    path = folder / "note.json"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_record_comes_back(tmp_path: Path) -> None:
    values = {"count": 3, "share": 1, "flat": True, "scores": {"a": 0.5}, "decisions": [{"what": "x", "why": "y"}]}
    write_json(tmp_path / "note.json", values)
    note = read_record(Note, tmp_path / "note.json", REMEDY)
    assert note == Note(3, 1, True, None, {"a": 0.5}, (Decision("x", "y"),))
    assert [path.name for path in tmp_path.iterdir()] == ["note.json"]  # nothing is left of the writing


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('{"count": 3, "sha', "Unterminated string"),
        ("[1]", "it holds a list, not an object"),
        ('{"count": 3, "share": 0.5}', "flat"),
        ('{"count": 3, "share": 0.5, "flat": true, "colour": 1}', "has no key colour"),
        ('{"count": "3", "share": 0.5, "flat": true}', "count is '3'"),
        ('{"count": 3, "share": true, "flat": true}', "share is True"),
        ('{"count": 3, "share": 0.5, "flat": 1}', "flat is 1"),
        ('{"count": 3, "share": 0.5, "flat": true, "title": 4}', "title is 4"),
        ('{"count": 3, "share": 0.5, "flat": true, "scores": {"a": "b"}}', r"scores\.a is 'b'"),
        ('{"count": 3, "share": 0.5, "flat": true, "decisions": [["x", "y"]]}', "cannot be read"),
        ('{"count": 3, "share": 0.5, "flat": true, "decisions": null}', "decisions is None"),
        ('{"count": 3, "share": 0.5, "flat": true, "decisions": [{"what": "x", "why": null}]}', "why is None"),
    ],
)
def test_a_damaged_file_names_itself_the_reason_and_the_remedy(tmp_path: Path, text: str, why: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(RtgsError, match=why) as raised:
        read_record(Note, path, REMEDY)
    assert str(raised.value).startswith(f"{path} cannot be read as a record (")
    assert str(raised.value).endswith(f": {REMEDY}")


def test_a_missing_file_and_bytes_that_are_no_text(tmp_path: Path) -> None:
    with pytest.raises(RtgsError, match=r"none.json cannot be read .*No such file"):
        read_json(tmp_path / "none.json")
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe{}")
    with pytest.raises(RtgsError, match=r"bytes.json cannot be read .*rtgs cache verify"):
        read_json(tmp_path / "bytes.json")


def test_an_interrupted_write_leaves_the_file_that_was_there(tmp_path: Path) -> None:
    path = tmp_path / "note.json"
    write_json(path, {"count": 1})
    with pytest.raises(TypeError):
        write_json(path, {"count": object()})
    assert json.loads(path.read_text()) == {"count": 1}
