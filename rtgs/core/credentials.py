"""Passwords and tokens inside addresses: they are used, and never written down."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from functools import cache
from urllib.parse import unquote

HIDDEN = "***"
# Keys of the config that hold an address, and where their value goes when it holds a password.
ADDRESSES = {"tracking.uri": "RTGS_TRACKING_URI", "paths.remote": "RTGS_REMOTE"}
_URL = re.compile(r"([A-Za-z][\w+.-]*)://([^\s'\"]*)")
_NAME = r"(?i)([?&;][\w.-]*(?:pass|pwd|secret|token|key|credential|signature)[\w.-]*=)"
_NAMED = re.compile(rf"{_NAME}[^&;\s'\"]+")
_NAMED_ALONE = re.compile(rf"{_NAME}([^&;]+)")  # in an address that is known to be one: any sign may be in it
# A host that is an IPv6 address, and its port: two colons at least, so that a user and password are not taken for one.
_IPV6 = re.compile(r"\[[0-9A-Fa-f]*:[0-9A-Fa-f]*:[0-9A-Fa-f:.]*(?:%[\w.~-]+)?\](?::\d*)?")
_SHORT = 8  # letters; a password of fewer may be a word of any text, and is hidden only where its user stands before it
_addresses: set[str] = set()  # that this process was given


def redact(text: str) -> str:
    """``text`` with ``***`` for the user and password of every URL, and for values of its query that are secrets.

    Passwords with quotes or blanks are found where their address is known: by :func:`hide`, or from the environment.
    """
    known = {*_addresses, *(os.environ.get(variable, "") for variable in ADDRESSES.values())}
    for address in sorted(known):
        for literal, shown in _secrets(address):
            text = literal.sub(shown, text)
    return _NAMED.sub(rf"\g<1>{HIDDEN}", _without_users(text))


def hide(address: str) -> None:
    """:func:`redact` finds the secrets of this address from now on, whatever signs they hold."""
    if next(iter(_secrets(address)), None) is not None:
        _addresses.add(address)


def words_without_credentials(words: Sequence[str]) -> list[str]:
    """A command line whose addresses with a password refer to the environment, where their values go.

    So Hydra, which writes and prints the words of a run in many places, never sees them. Processes that a launcher
    starts inherit the environment.
    """
    return [_without_credentials(word) for word in words]


def _without_credentials(word: str) -> str:
    key, _, value = word.partition("=")
    variable = ADDRESSES.get(key.lstrip("+"))
    quote = value[:1] if value[:1] in ("'", '"') and value[-1:] == value[:1] and len(value) > 1 else ""
    plain = value[1:-1].replace(f"\\{quote}", quote) if quote else value
    if variable is None or not _secrets(plain):
        return word
    os.environ[variable] = plain
    return f"{key}=${{oc.env:{variable}}}"


def _without_users(text: str) -> str:
    def shown(match: re.Match[str]) -> str:
        scheme, rest = match.groups()
        user = _user(scheme, rest)
        return f"{scheme}://{HIDDEN}@{_without_users(rest[len(user) + 1 :])}" if user else match[0]

    return _URL.sub(shown, text)


def _user(scheme: str, rest: str) -> str:
    """``user:password``, or a token, before the host of ``scheme://rest``; empty where there is none."""
    place = re.split("[/?#]", rest, maxsplit=1)[0]
    if "@" in place:
        return place.rpartition("@")[0]
    if _IPV6.fullmatch(place):  # an @ in the path
        return ""
    _, colon, after = place.partition(":")
    if not colon or (after.isdigit() and "sql" not in scheme):  # host:port, and an @ in the path
        return ""
    return rest.rpartition("@")[0]  # drivers of databases take a password with a slash as it is


@cache
def _secrets(address: str) -> tuple[tuple[re.Pattern[str], str], ...]:
    """Where the secrets of an address stand in any text, and what is to stand there."""
    return tuple((re.compile(pattern), shown) for pattern, shown in _literals(address.strip()))


def _literals(address: str) -> Iterator[tuple[str, str]]:
    scheme, _, rest = address.partition("://")
    user = _user(scheme, rest)
    if user:
        yield rf"(?<!\w){_spelled(user)}@", f"{HIDDEN}@"
    passwords = {user.partition(":")[2]}
    for name, value in _NAMED_ALONE.findall(address):
        yield _spelled(name + value), f"{name}{HIDDEN}"
        passwords.add(value)
    for password in passwords | {unquote(each) for each in passwords}:
        if len(password) >= _SHORT:
            yield rf"(?<!\w){_spelled(password)}(?!\w)", HIDDEN


def _spelled(literal: str) -> str:
    """A pattern of a text as it is, and as YAML, JSON and Python write it in quotes and fold it at blanks."""
    ways = {"'": r"\\?'{1,2}", '"': r'\\?"{1,2}', "\\": r"\\{1,2}"}
    return "".join(r"[\s\\]+" if sign.isspace() else ways.get(sign, re.escape(sign)) for sign in literal)
