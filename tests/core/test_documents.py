"""Documents of strangers: read within limits, refused in words."""

from __future__ import annotations

import math
import re
import tracemalloc
from pathlib import Path

import pytest

from rtgs.core.documents import (
    DEPTH,
    JSON_BYTES,
    TYPED_BYTES,
    DocumentError,
    load_json,
    load_toml,
    load_yaml,
    parse_json,
)

ROOT = Path(__file__).resolve().parents[2]
BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi")
)


def written(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refused(load, path: Path, message: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(DocumentError, match=message) as error:
            load(path)
        assert len(str(error.value)) < 300
        assert tracemalloc.get_traced_memory()[1] < 300 * 2**20
    finally:
        tracemalloc.stop()


def test_what_is_within_the_limits_is_read(tmp_path):
    assert load_json(written(tmp_path, "a.json", '{"a": [1, 2.5, null, "ä"]}')) == {"a": [1, 2.5, None, "ä"]}
    assert math.isnan(parse_json("[NaN]")[0])
    assert load_toml(written(tmp_path, "a.toml", "[a]\nb = 1")) == {"a": {"b": 1}}
    assert load_yaml(written(tmp_path, "a.yaml", "a: &x [1, 2]\nb: *x")) == {"a": [1, 2], "b": [1, 2]}
    deepest = "[" * DEPTH + "]" * DEPTH
    assert load_yaml(written(tmp_path, "b.yaml", deepest)) == load_json(written(tmp_path, "b.json", deepest))


def test_a_bomb_of_aliases_is_refused_before_it_grows(tmp_path):
    assert len(BOMB) < 500
    refused(load_yaml, written(tmp_path, "a.yaml", BOMB), "more than 1000000 values, aliases written out")
    refused(load_yaml, written(tmp_path, "a.yaml", "a: &a [*a]"), r"alias \*a stands for nothing, or for itself")
    refused(load_yaml, written(tmp_path, "a.yaml", f"a: *{'9' * 5000}"), r"alias \*9{200}\.\.\. stands for nothing")


@pytest.mark.parametrize("depth", [DEPTH + 1, 500, 100_000])
def test_deep_nesting_is_refused(tmp_path, depth):
    nested = "[" * depth + "]" * depth
    message = f"nested more than {DEPTH} levels deep"
    refused(load_json, written(tmp_path, "a.json", nested), message)
    refused(load_json, written(tmp_path, "b.json", '{"a":' * depth + "1" + "}" * depth), message)
    refused(load_yaml, written(tmp_path, "a.yaml", nested), message)
    refused(load_toml, written(tmp_path, "a.toml", f"a = {nested}"), message)


@pytest.mark.parametrize("digits", [20, 400, 10_000])
def test_integers_of_many_digits_are_refused(tmp_path, digits):
    number = "9" * digits
    message = "a.b.*(whole numbers go up to|Exceeds the limit)" if digits < 5000 else "Exceeds the limit"
    refused(load_json, written(tmp_path, "a.json", f'{{"a": {{"b": {number}}}}}'), message)
    refused(load_yaml, written(tmp_path, "a.yaml", f"a:\n  b: {number}"), message)
    refused(load_toml, written(tmp_path, "a.toml", f"[a]\nb = {number}"), message)
    refused(load_yaml, written(tmp_path, "b.yaml", f"a: 0x{'f' * 10_000}"), "a is a whole number of 40000 bits")


def test_large_files_are_not_read(tmp_path):
    refused(load_json, written(tmp_path, "a.json", b" " * (JSON_BYTES + 1)), f"larger than {JSON_BYTES} bytes")
    refused(load_yaml, written(tmp_path, "a.yaml", b" " * (TYPED_BYTES + 1)), f"larger than {TYPED_BYTES} bytes")
    refused(load_toml, written(tmp_path, "a.toml", b" " * (TYPED_BYTES + 1)), f"larger than {TYPED_BYTES} bytes")


NO_DOCUMENTS = [b"\xff\xfe", b"a: [", b"\x00", b"!!python/object:os.system x", b"!!int x", b"? {}"]


@pytest.mark.parametrize("content", NO_DOCUMENTS)
def test_what_is_no_document_is_refused(tmp_path, content):
    refused(load_json, written(tmp_path, "a.json", content), r"\S")
    if content != b"? {}":
        refused(load_toml, written(tmp_path, "a.toml", content), r"\S")
    refused(load_yaml, written(tmp_path, "a.yaml", content), r"\S")


def test_everybody_reads_through_this_module():
    """Other calls read what this process made a moment ago."""
    own = {"rtgs/core/documents.py", "rtgs/workflow/fingerprint.py", "pipelines/publishing/results.py"}
    own.add("rtgs/workflow/step.py")  # an error of its own, for another process
    own.add("rtgs/core/apart.py")  # what a process says that this one started
    reads = re.compile(r"(json|tomllib|pickle)\.loads?\(|yaml\.(safe_|full_|unsafe_)?load\(|allow_pickle=True")
    found = {
        path.relative_to(ROOT).as_posix()
        for room in ("rtgs", "pipelines", "hydra_plugins")
        for path in (ROOT / room).rglob("*.py")
        if reads.search(path.read_text(encoding="utf-8"))
    }
    assert found == own
