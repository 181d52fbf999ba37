"""A viser server that listens where it is told to, answers its own pages alone, and opens no way to the outside."""

from __future__ import annotations

import contextlib
import functools
import io
import ipaddress
import logging
import os
import re
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING
from unittest import mock

from rtgs.core.errors import RtgsError

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]  (an extra)

    from rtgs.view.settings import ViewerSettings

NEEDS_VISER = "the viewer needs viser: pip install -e '.[viewer]' in the clone of rtgs"
# A browser says from which page a connection comes. Pages of others must not reach a server on the loopback address.
_LOOPBACK = ("localhost", "127.0.0.1", "[::1]")


def need_viser() -> None:
    """Raises: RtgsError: viser is not there."""
    try:
        import viser  # noqa: F401  # pyright: ignore[reportMissingImports]  (an extra)
    except ImportError as error:
        raise RtgsError(f"{NEEDS_VISER} ({error})") from None


@contextmanager
def serving(settings: ViewerSettings, label: str) -> Iterator[viser.ViserServer]:
    """A server while the block runs.

    Raises:
        RtgsError: viser is not there, or the address is none of this machine.
    """
    need_viser()
    import viser  # pyright: ignore[reportMissingImports]  (an extra)
    from websockets.asyncio import server as sockets

    _check_host(settings.host)
    logging.getLogger("websockets").setLevel(logging.WARNING)  # it tells of every connection
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")  # a page closed meanwhile
    allowed = [None, _own_pages(settings.host)] if is_loopback(settings.host) else None
    own = functools.partial(sockets.serve, origins=allowed)
    with (
        mock.patch.object(sockets, "serve", own),
        mock.patch.dict(os.environ),
        contextlib.redirect_stdout(io.StringIO()),  # its address is told by who opens it
    ):
        os.environ.pop("_VISER_PORT_OVERRIDE", None)
        server = viser.ViserServer(settings.host, settings.port, label, verbose=False)
    server.request_share_url = _refuse_share  # type: ignore[method-assign]  (a page can ask for it without the button)
    server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True, control_width="large")
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def address(server: viser.ViserServer) -> str:
    """What to open in a browser."""
    host = server.get_host()
    shown = socket.gethostname() if host in ("0.0.0.0", "::", "") else f"[{host}]" if ":" in host else host
    return f"http://{shown}:{server.get_port()}"


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    if host == "localhost":
        return True
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False


def _own_pages(host: str) -> re.Pattern[str]:
    """What a browser calls the pages of this machine: 127.0.0.2 is a loopback address as well."""
    names = "|".join(re.escape(name) for name in dict.fromkeys((*_LOOPBACK, _in_address(host))))
    return re.compile(rf"https?://({names})(:\d+)?")


def _in_address(host: str) -> str:
    """As a browser writes a loopback host."""
    if host == "localhost":
        return host
    place = ipaddress.ip_address(host)
    return f"[{place}]" if place.version == 6 else str(place)


def _refuse_share(verbose: bool = True) -> None:
    return None


def _check_host(host: str) -> None:
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.bind(place)
    except (OSError, UnicodeError) as error:
        what = f"this machine cannot listen there ({error}); 127.0.0.1 is the default"
        raise RtgsError(f"viewer.host={host}: {what}") from None
