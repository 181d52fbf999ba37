"""Where Dask listens, and who is let in where its traffic is encrypted: certificates of the test's own, on loopback."""

from __future__ import annotations

import asyncio
import os
import socket
import ssl
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import toy
from distributed import Client, Scheduler
from distributed.security import Security

from rtgs.core.errors import RtgsError
from rtgs.workflow import Store, make_plan
from rtgs.workflow.engine import DaskExecutor, EngineSettings, WorkerJob, open_client, scheduler_pages


def certificate_files(folder: Path) -> dict[str, str]:
    """A certificate that is its own authority, as the words of a launcher."""
    pytest.importorskip("cryptography", reason="makes the certificates")
    made = Security.temporary()
    texts = {"tls_ca": made.tls_ca_file, "tls_cert": made.tls_client_cert, "tls_key": made.tls_client_key}
    folder.mkdir()
    for name, text in texts.items():
        (folder / f"{name}.pem").write_text(str(text))
    return {name: str(folder / f"{name}.pem") for name in texts}


@pytest.fixture
def files(tmp_path) -> dict[str, str]:
    return certificate_files(tmp_path / "own")


def _handshake(address: str, words: dict[str, str] | None) -> bytes:
    """What a scheduler says first to somebody with this certificate, or with none."""
    host, port = address.removeprefix("tls://").split(":")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    if words is not None:
        context.load_cert_chain(words["tls_cert"], words["tls_key"])
    with socket.create_connection((host, int(port)), timeout=30) as plain, context.wrap_socket(plain) as wrapped:
        return wrapped.recv(8)


def test_steps_run_over_tls_and_nobody_without_a_certificate_is_let_in(tmp_path, files, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(toy.__file__).parent), *filter(None, sys.path)]))
    store = Store(tmp_path / "store")
    with open_client(EngineSettings(workers=1, threads=1, **files)) as client:
        address = client.scheduler.address  # pyright: ignore[reportOptionalMemberAccess]
        workers = list(client.scheduler_info()["workers"])
        outcomes = DaskExecutor(client, WorkerJob(str(store.root), 1)).attempt(make_plan(toy.graph(tmp_path), store))
        assert _handshake(address, files)  # the scheduler's greeting
        stranger = certificate_files(tmp_path / "stranger")
        for words in (None, stranger):
            with pytest.raises((ssl.SSLError, ConnectionError)):
                _handshake(address, words)
        with pytest.raises((OSError, TypeError, RuntimeError, ValueError)):
            Client(address.replace("tls://", "tcp://"), timeout="2s")
    assert not outcomes.failures
    assert len(toy.executions(tmp_path)) == 5
    assert all(each.startswith("tls://127.0.0.1:") for each in [address, *workers])


@pytest.mark.parametrize("name", ["tls_ca", "tls_cert", "tls_key"])
def test_half_a_set_of_files_is_refused(files, name: str):
    with pytest.raises(RtgsError, match=rf"hydra\.launcher\.{name} is missing"):
        EngineSettings(**files | {name: ""})
    with pytest.raises(RtgsError, match=rf"hydra\.launcher\.{name}=nowhere is no file"):
        EngineSettings(**files | {name: "nowhere"})


def test_an_address_without_tls_is_refused_where_tls_is_asked_for(files):
    with pytest.raises(RtgsError, match="not encrypted"):
        EngineSettings(kind="address", address="tcp://host:8786", **files)
    EngineSettings(kind="address", address="tls://host:8786", **files)


@pytest.mark.parametrize(("asked", "served"), [("", "127.0.0.1"), ("127.0.0.2:0", "127.0.0.2")])
def test_a_scheduler_of_ours_serves_pages_on_loopback_unless_asked(asked: str, served: str):
    settings = replace(EngineSettings(), dashboard=asked)

    async def address() -> str:
        async with Scheduler(host="0.0.0.0", port=0, **scheduler_pages(settings)) as scheduler:
            return scheduler.http_server.address

    assert asyncio.run(address()) == served
