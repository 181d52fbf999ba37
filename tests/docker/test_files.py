"""The container files, checked with the tools made for them: no container engine runs here, so nothing is built."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from rtgs.workflow.engine import worker_environment

DOCKER = Path(__file__).parents[2] / "docker"
COMPOSE = DOCKER / "compose.yaml"
BIN = Path(sys.executable).parent


def tool(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    path = BIN / name
    if not path.exists():
        pytest.skip(f"{name} is not installed (extra dev)")
    return subprocess.run([str(path), *arguments], capture_output=True, text=True)


def services() -> dict[str, dict]:
    return yaml.safe_load(COMPOSE.read_text())["services"]


def test_dockerfile_passes_hadolint():
    done = tool("hadolint", str(DOCKER / "Dockerfile"))
    assert done.returncode == 0, done.stdout


def test_compose_file_fits_the_specification():
    done = tool("check-jsonschema", "--builtin-schema", "vendor.compose-spec", str(COMPOSE))
    assert done.returncode == 0, done.stdout


def test_kubernetes_manifest_fits_the_api():
    done = tool("kubernetes-validate", "--strict", str(DOCKER / "kubernetes.yaml"))
    assert done.returncode == 0, done.stdout + done.stderr


def test_ports_are_published_on_loopback_unless_told_otherwise():
    ports = [port for service in services().values() for port in service.get("ports", [])]
    assert ports
    assert all(port.startswith("${RTGS_BIND:-127.0.0.1}:") for port in ports)


def test_every_service_has_a_health_check_and_is_not_root():
    for name, service in services().items():
        one_shot = name in ("volume", "buckets", "rtgs")
        assert one_shot or "healthcheck" in service, name
        assert service.get("user") not in (None, "root", "0"), name


def test_the_health_check_of_a_worker_fails_where_there_is_none():
    """A shell that looks for a command line finds its own."""
    if shutil.which("pgrep") is None:
        pytest.skip("no pgrep here (procps)")
    kind, command = services()["worker"]["healthcheck"]["test"]
    assert kind == "CMD-SHELL"
    wrapped = ["sh", "-c", command + "; exit $?"]  # no shell may replace itself by the last command
    assert subprocess.run(wrapped).returncode == 1
    stand_in = subprocess.Popen([sys.executable, "-c", "input()", "dask worker"], stdin=subprocess.PIPE)
    try:
        assert subprocess.run(wrapped).returncode == 0
    finally:
        stand_in.communicate()


def test_no_password_has_a_default_and_every_variable_is_documented():
    text = COMPOSE.read_text()
    documented = set(re.findall(r"^([A-Z0-9_]+)=", (DOCKER / ".env.example").read_text(), re.M))
    for name, rest in re.findall(r"\$\{([A-Z0-9_]+)([^}]*)\}", text):
        assert name in documented, name
        if re.search("PASSWORD|KEY", name):
            assert rest.startswith(":?"), f"{name} must be demanded, not defaulted"
    secrets = re.findall(r"^(\w*(?:PASSWORD|KEY)\w*)=(.*)$", (DOCKER / ".env.example").read_text(), re.M)
    assert secrets
    assert all(not value for _, value in secrets)


@pytest.fixture
def entry(tmp_path):
    """Run the entry point with stand-ins for dask, mlflow and rtgs that print what they were called with."""
    for name in ("dask", "mlflow", "rtgs"):
        path = tmp_path / name
        path.write_text(f'#!/bin/sh\necho "{name} $* OMP=${{OMP_NUM_THREADS:-}} TRIM=${{MALLOC_TRIM_THRESHOLD_:-}}"\n')
        path.chmod(0o755)

    def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        clean = {"PATH": f"{tmp_path}{os.pathsep}/usr/bin{os.pathsep}/bin", **environment}
        command = ["sh", str(DOCKER / "entrypoint.sh"), *arguments]
        return subprocess.run(command, env=clean, capture_output=True, text=True)

    return run


def test_entry_point_passes_commands_of_rtgs_on(entry):
    assert entry("run", "scene=demo", "a b").stdout.startswith("rtgs run scene=demo a b")
    assert entry().stdout.startswith("rtgs ")


def test_worker_has_one_step_at_a_time_and_its_threads(entry):
    out = entry("worker", RTGS_SCHEDULER="tcp://s:8786", RTGS_THREADS="3").stdout
    assert out.startswith("dask worker tcp://s:8786 --nworkers 1 --nthreads 1")
    assert "OMP=3" in out
    assert f"TRIM={worker_environment(3)['MALLOC_TRIM_THRESHOLD_']}" in out


def test_tracking_server_takes_its_secrets_from_the_environment_only(entry):
    out = entry(
        "tracking", MLFLOW_BACKEND_STORE_URI="postgresql://u:secret@h/d", MLFLOW_ARTIFACTS_DESTINATION="s3://b"
    ).stdout
    assert out.startswith("mlflow server --host 0.0.0.0 --port 5000")
    assert "secret" not in out


@pytest.mark.parametrize(
    ("command", "missing"), [("worker", "RTGS_SCHEDULER"), ("tracking", "MLFLOW_BACKEND_STORE_URI")]
)
def test_what_is_missing_is_named(entry, command, missing):
    done = entry(command)
    assert done.returncode == 2
    assert f"{missing} is not set" in done.stderr
    assert ".env.example" in done.stderr


def test_cluster_and_server_configs_read_the_environment(monkeypatch):
    from rtgs.config import compose

    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://tracking:5000")
    config, _ = compose(["tracking=server"])
    assert (config.tracking.kind, config.tracking.uri) == ("mlflow", "http://tracking:5000")
