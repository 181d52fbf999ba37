"""Ways to damage a file: by bytes, by its numbers, by lines, by the structure of JSON. All from one ``Random``."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from random import Random
from typing import Any

_WORDS = (
    b"0", b"-1", b"1", b"nan", b"NaN", b"inf", b"-inf", b"1e999", b"-1e999", b"1e-320", b"1e300", b"4294967296",
    b"18446744073709551615", b"9" * 400, b"0x" + b"f" * 300, b"null", b"true", b'""', b"[]", b"{}", b"", b"\0",
    b"../../x.jpg", b"/tmp/x", b"C:\\x", b"\xff\xfe", b"*a", b"&a [*a]", b"!!python/name:os.system",
)  # fmt: skip
_INTEGERS = (0, 1, 2, 7, 127, 128, 255, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
_FLOATS = (0.0, -0.0, -1.0, 1e-300, 1e300, 5e22, float("nan"), float("inf"), float("-inf"))
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 10**400, 2**63, 1e-320, 1e300, float("nan"), float("inf"), "", ".", "..", "../x.jpg",
    "/tmp/x.jpg", "a\0b", "x" * 5000, "\udc80", [], {}, [[]], {"": {}}, [None] * 50, {"a": [1, {"b": "c"}]},
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")


def mutated(data: bytes, random: Random) -> bytes:
    """One to four mutations of ``data``, one after the other."""
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        data = random.choice(MUTATIONS)(data, random)
    return data[: 2**20]


def flip_bits(data: bytes, random: Random) -> bytes:
    """One to eight bits."""
    out = bytearray(data)
    for _ in range(random.randint(1, 8) if out else 0):
        out[random.randrange(len(out))] ^= 1 << random.randrange(8)
    return bytes(out)


def cut(data: bytes, random: Random) -> bytes:
    """The end is missing."""
    return data[: random.randrange(len(data) + 1)]


def remove(data: bytes, random: Random) -> bytes:
    """A piece in the middle is missing."""
    start = random.randrange(len(data) + 1)
    return data[:start] + data[start + random.randint(1, 64) :]


def repeat(data: bytes, random: Random) -> bytes:
    """A piece comes again, up to a thousand times."""
    start = random.randrange(len(data) + 1)
    piece = data[start : start + random.randint(1, 64)]
    return data[:start] + piece * random.choice((2, 2, 3, 1000)) + data[start:]


def overwrite_integer(data: bytes, random: Random) -> bytes:
    """A count, a size, an offset of 1 to 8 bytes, either end first."""
    form = random.choice("BHIQ")
    return _packed(
        data, random, random.choice("<>") + form, random.choice(_INTEGERS) % 2 ** (8 * struct.calcsize(form))
    )


def overwrite_float(data: bytes, random: Random) -> bytes:
    """A number of 4 or 8 bytes."""
    value, form = random.choice(_FLOATS), random.choice(("<d", "<f", ">d"))
    return _packed(data, random, form, value if form[1] == "d" or abs(value) < 1e30 else 5e22)


def _packed(data: bytes, random: Random, form: str, value: float) -> bytes:
    size = struct.calcsize(form)
    if len(data) < size:
        return data
    start = random.randrange(len(data) - size + 1)
    if random.random() < 0.5:
        start -= start % min(size, 4)
    return data[:start] + struct.pack(form, value) + data[start + size :]


def replace_number(data: bytes, random: Random) -> bytes:
    """A number in a text becomes a word that readers stumble over."""
    found = list(_NUMBER.finditer(data))
    if not found:
        return flip_bits(data, random)
    match = random.choice(found)
    return data[: match.start()] + random.choice(_WORDS) + data[match.end() :]


def replace_word(data: bytes, random: Random) -> bytes:
    """A word does."""
    found = list(re.finditer(rb"[A-Za-z_./\"]+", data))
    if not found:
        return flip_bits(data, random)
    match = random.choice(found)
    return data[: match.start()] + random.choice(_WORDS) + data[match.end() :]


def shuffle_lines(data: bytes, random: Random) -> bytes:
    """Lines change places, go, or come twice."""
    lines = data.split(b"\n")
    first, second = random.randrange(len(lines)), random.randrange(len(lines))
    lines[first], lines[second] = lines[second], random.choice((lines[first], lines[second], b""))
    return b"\n".join(lines)


def nest(data: bytes, random: Random) -> bytes:
    """Deep brackets in the middle."""
    start, depth = random.randrange(len(data) + 1), random.choice((10, 100, 5000))
    opening, closing = random.choice(((b"[", b"]"), (b"(", b")"), (b'{"a":', b"}"), (b"a: [", b"]")))
    return data[:start] + opening * depth + closing * random.choice((0, depth)) + data[start:]


def change_json(data: bytes, random: Random) -> bytes:
    """A node of a JSON text becomes another value, goes, or comes twice; other files are left to the next mutation."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return replace_number(data, random)
    holders = [value for value in _nodes(content) if value]
    if not holders:
        return json.dumps(random.choice(_VALUES)).encode()
    holder = random.choice(holders)
    key = random.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    action = random.randrange(4)
    if action == 0:
        del holder[key]
    elif action == 1 and isinstance(holder, list):
        holder.append(holder[key])
    elif action == 1:
        holder[random.choice(("", "unknown", "name", "file_path"))] = random.choice(_VALUES)
    else:
        holder[key] = random.choice(_VALUES)
    return json.dumps(content).encode()


def _nodes(content: Any) -> list[Any]:
    found, open_nodes = [], [content]
    while open_nodes:
        node = open_nodes.pop()
        if isinstance(node, dict | list):
            found.append(node)
            open_nodes += node.values() if isinstance(node, dict) else node
    return found


MUTATIONS: tuple[Callable[[bytes, Random], bytes], ...] = (
    flip_bits, cut, remove, repeat, overwrite_integer, overwrite_integer, overwrite_float, replace_number,
    replace_number, replace_word, shuffle_lines, nest, change_json, change_json,
)  # fmt: skip
