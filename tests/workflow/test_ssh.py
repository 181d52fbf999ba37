"""Plans on workers started over SSH: a server of the test's own on the loopback address, keys made for it."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import toy
from test_engine import _count_threads, soon
from test_wire import certificate_files
from toy import ToyParams

from rtgs.core.errors import RtgsError
from rtgs.workflow import Step, Store, SweepOutcomes, make_plan
from rtgs.workflow.engine import DaskExecutor, EngineSettings, WorkerJob, open_client

asyncssh = pytest.importorskip("asyncssh", reason="no asyncssh here: pip install -e '.[cluster]'")
pytestmark = pytest.mark.filterwarnings("ignore:coroutine 'Queue.join'")  # asyncssh's, at the end of a command
HOSTS = ("one", "two", "three")  # names of ~/.ssh/config, all of them this machine


class Server:
    """An SSH server that runs what it is asked to in a shell, as sshd does."""

    def __init__(self, folder: Path) -> None:
        self.port = 0
        self._folder = folder
        self._children: list[asyncio.subprocess.Process] = []
        self._ready, self._stop = threading.Event(), asyncio.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))

    def __enter__(self) -> Server:
        self._thread.start()
        assert self._ready.wait(30)
        return self

    def __exit__(self, *exception: object) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(30)

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        keys = {
            "server_host_keys": [str(self._folder / "host")],
            "authorized_client_keys": str(self._folder / "allowed"),
        }
        async with await asyncssh.listen("127.0.0.1", 0, process_factory=self._run, encoding=None, **keys) as listening:
            self.port = listening.get_port()
            self._ready.set()
            await self._stop.wait()
        for child in self._children:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            await child.wait()

    async def _run(self, session) -> None:
        pipe = asyncio.subprocess.PIPE
        pipes = {"stdin": pipe, "stdout": pipe, "stderr": pipe}
        child = await asyncio.create_subprocess_shell(session.command, start_new_session=True, **pipes)
        self._children.append(child)
        await session.redirect(child.stdin, child.stdout, child.stderr)
        await session.stdout.drain()  # the end of what the command printed
        await session.stderr.drain()
        session.exit(await child.wait())


@pytest.fixture
def hosts(tmp_path_factory, monkeypatch) -> Iterator[list[str]]:
    """Hosts a person could log in to without a password, as far as ``~/.ssh`` of this test is concerned."""
    folder = tmp_path_factory.mktemp("ssh")
    home = folder / "home" / ".ssh"
    home.mkdir(parents=True)
    host, user = (asyncssh.generate_private_key("ssh-ed25519") for _ in range(2))
    host.write_private_key(str(folder / "host"))
    user.write_private_key(str(home / "id_ed25519"))
    user.write_public_key(str(folder / "allowed"))
    with Server(folder) as server:
        public = host.export_public_key().decode().strip()
        (home / "known_hosts").write_text(f"[127.0.0.1]:{server.port} {public}\n")
        lines = ["HostName 127.0.0.1", f"Port {server.port}", f"IdentityFile {home / 'id_ed25519'}"]
        lines.append(f"UserKnownHostsFile {home / 'known_hosts'}")
        (home / "config").write_text(f"Host {' '.join(HOSTS)}\n  " + "\n  ".join(lines) + "\n")
        monkeypatch.setenv("HOME", str(home.parent))
        monkeypatch.setenv("OMP_NUM_THREADS", "1")  # what the hosts say themselves
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(Path(toy.__file__).parent), *sys.path])))
        yield list(HOSTS)


def test_workers_over_ssh_run_each_step_once_and_a_killed_one_is_replaced(hosts, tmp_path):
    (tmp_path / "gate").touch()
    store, found = Store(tmp_path / "store"), []
    counting = Step("count", 1, ToyParams(0.0, str(tmp_path)), _count_threads)
    plan = make_plan([counting, *toy.graph(tmp_path)], store)

    def attempt() -> SweepOutcomes:
        with open_client(EngineSettings(kind="ssh", hosts=hosts, threads=2)) as client:
            return DaskExecutor(client, WorkerJob(str(store.root), 2)).attempt(plan)

    thread = threading.Thread(target=lambda: found.append(attempt()))
    thread.start()
    log = tmp_path / "executions.log"
    soon(lambda: log.exists() and "geom waits" in log.read_text(), "geom reached the gate")
    os.kill(_owner(store.lock(toy.graph(tmp_path)[0].upstream[0]).lock_file), signal.SIGKILL)
    (tmp_path / "gate").unlink()
    thread.join(60)
    assert found
    assert not found[0].failures
    assert sorted(toy.executions(tmp_path)) == [
        "geom from 0",
        "geom from 5",
        "prep",
        "train 0.1",
        "train 0.2",
        "train 0.3",
    ]
    assert (store.folder(counting) / "threads.txt").read_text() == "2 2 quiet"


def test_over_ssh_all_traffic_is_encrypted_and_pages_are_on_loopback(hosts, tmp_path):
    files = certificate_files(tmp_path / "certificates")
    with open_client(EngineSettings(kind="ssh", hosts=hosts, **files)) as client:
        client.wait_for_workers(2, timeout=60)
        workers = list(client.scheduler_info()["workers"])
        pages = [client.run_on_scheduler(_pages_of_scheduler), *client.run(_pages_of_worker).values()]
        address = client.scheduler.address  # pyright: ignore[reportOptionalMemberAccess]
    assert all(each.startswith("tls://") for each in (address, *workers))
    assert pages == ["127.0.0.1"] * 3


def _pages_of_scheduler(dask_scheduler) -> str:
    return dask_scheduler.http_server.address


def _pages_of_worker(dask_worker) -> str:
    return dask_worker.http_server.address


def _owner(lock_file: str) -> int:
    """The process that holds a kernel lock open."""
    inode = Path(lock_file).stat().st_ino
    for line in Path("/proc/locks").read_text().splitlines():
        if line.split()[5].endswith(f":{inode}"):
            return int(line.split()[4])
    return pytest.fail(f"nobody holds {lock_file}")


def test_a_host_that_does_not_let_us_in_is_named(hosts):
    (Path.home() / ".ssh" / "known_hosts").write_text("")
    with (
        pytest.raises(RtgsError, match="ssh cluster did not start"),
        open_client(EngineSettings(kind="ssh", hosts=hosts)),
    ):
        pass
