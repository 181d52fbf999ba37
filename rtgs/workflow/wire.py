"""TLS between the processes of a Dask cluster: whoever has no certificate of its authority is turned away."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from pathlib import Path

from rtgs.core.errors import RtgsError


@dataclass(frozen=True)
class TlsFiles:
    """Paths of PEM files, or all empty: no TLS."""

    authority: str
    certificate: str
    key: str

    @property
    def protocol(self) -> str:
        """Of Dask's addresses."""
        return "tls" if self.authority else "tcp"


def check_tls(files: TlsFiles, address: str) -> None:
    """Refuse half a set of files, files that are not here, and a scheduler that would be reached without them.

    Raises:
        RtgsError: names the setting and the file.
    """
    names = ("tls_ca", "tls_cert", "tls_key")
    given = dict(zip(names, astuple(files)))
    if not any(given.values()):
        return
    for name, path in given.items():
        if not path:
            raise RtgsError(f"hydra.launcher.{name} is missing: TLS needs {', '.join(names)}, three files in PEM form")
        if not Path(path).is_file():
            raise RtgsError(f"hydra.launcher.{name}={path} is no file here")
    if address and not address.startswith("tls://"):
        raise RtgsError(f"hydra.launcher.address={address} is not encrypted although tls_ca is given: tls://host:port")


def tls_config(files: TlsFiles) -> dict[str, object]:
    """Keys of Dask's config, which the processes of a cluster inherit; empty without TLS.

    All roles have one certificate: each may do anything as the user who started the cluster anyway.
    """
    if not files.authority:
        return {}
    paths = {name: str(Path(path).absolute()) for name, path in vars(files).items()}
    keys: dict[str, object] = {
        "distributed.comm.require-encryption": True,
        "distributed.comm.default-scheme": "tls",
        "distributed.comm.tls.ca-file": paths["authority"],
    }
    for role in ("scheduler", "worker", "client"):
        keys[f"distributed.comm.tls.{role}.cert"] = paths["certificate"]
        keys[f"distributed.comm.tls.{role}.key"] = paths["key"]
    return keys
