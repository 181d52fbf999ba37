"""``rtgs cache``: the artifact store on this machine, and the one that machines share."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from rtgs.core.errors import RtgsError
from rtgs.core.listing import columns
from rtgs.workflow import Artifact, RemoteStore, Store

REMOTE_VARIABLE = "RTGS_REMOTE"


def main(words: list[str], root: Path) -> int:
    """Run one action; returns the exit code."""
    options = _parser(root).parse_args(words)
    store = Store(options.root / "store")
    if options.action == "ls":
        return _list(store)
    if options.action == "verify":
        return _verify(store)
    if options.action == "gc":
        removed = store.collect_garbage(partial=options.partial, older_than=options.older_than)
        print(f"removed {len(removed.paths)} folders, {removed.size / 1e6:.1f} MB")
        return 0
    if not options.remote:
        raise RtgsError(
            f"rtgs cache {options.action}: which remote store? --remote s3://bucket/path, or {REMOTE_VARIABLE}"
        )
    remote = RemoteStore(options.remote)
    return (_push if options.action == "push" else _pull)(store, remote, options.words)


def _parser(root: Path) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "rtgs cache",
        usage="rtgs cache ls | gc | verify | push [key=value ...] | pull [key=value ...]  [options]",
        description="The artifact store. push and pull take the words of `rtgs run` and move what that run or sweep is "
        "made of; without words, everything.",
    )
    parser.add_argument(
        "action",
        choices=("ls", "gc", "verify", "push", "pull"),
        help="list, remove garbage, check every digest, send to or fetch from a remote store",
    )
    parser.add_argument(
        "words", nargs="*", default=[], metavar="key=value", help="push, pull: which run (default: everything)"
    )
    parser.add_argument("--root", type=Path, default=root, help="folder that holds store/ (default: %(default)s)")
    parser.add_argument("--partial", action="store_true", help="gc: also checkpoints of unfinished steps")
    parser.add_argument("--older-than", type=float, metavar="DAYS", help="gc: also artifacts made before that")
    default = os.environ.get(REMOTE_VARIABLE, "")
    parser.add_argument("--remote", metavar="URL", default=default, help=f"push, pull (default: ${REMOTE_VARIABLE})")
    return parser


def _list(store: Store) -> int:
    artifacts = sorted(store.artifacts(), key=lambda artifact: artifact.manifest.created)
    rows = [("step", "key", "made", "took", "size")]
    for artifact in artifacts:
        manifest = artifact.manifest
        size, took = f"{manifest.size / 1e6:.1f} MB", f"{manifest.duration:.1f} s"
        rows.append((manifest.step, manifest.fingerprint[:12], manifest.created, took, size))
    print(columns(rows))
    total = sum(artifact.manifest.size for artifact in artifacts)
    print(f"\n{len(artifacts)} artifacts, {total / 1e6:.1f} MB in {store.root}")
    return 0


def _verify(store: Store) -> int:
    count, broken = 0, 0
    for artifact, defects in store.verify():
        count += 1
        if defects:
            broken += 1
            print(f"{artifact.folder}\n" + "\n".join(f"  {defect}" for defect in defects))
    print(
        f"{count} artifacts, {count - broken} sound" + (f", {broken} damaged: delete their folders" if broken else "")
    )
    return 1 if broken else 0


def _push(store: Store, remote: RemoteStore, words: list[str]) -> int:
    wanted = _recipes(words)
    sent, size, present = 0, 0, 0
    for artifact in store.artifacts():
        if wanted is not None and (artifact.manifest.step, artifact.manifest.fingerprint) not in wanted:
            continue
        if remote.push(artifact):
            sent += 1
            size += artifact.manifest.size
            print(f"sent {artifact.manifest.step} {artifact.manifest.fingerprint[:12]}", flush=True)
        else:
            present += 1
    print(f"{sent} artifacts sent to {remote.redacted}, {size / 1e6:.1f} MB; {present} were there already")
    return 0


def _pull(store: Store, remote: RemoteStore, words: list[str]) -> int:
    wanted = _recipes(words)
    fetched, size, present, absent = 0, 0, 0, 0
    for name, fingerprint in sorted(wanted) if wanted is not None else remote.artifacts():
        if store.has(name, fingerprint):
            present += 1
        elif artifact := _fetch(store, remote, name, fingerprint):
            fetched += 1
            size += artifact.manifest.size
            print(f"fetched {name} {fingerprint[:12]}", flush=True)
        else:
            absent += 1
    missing = f"; {absent} are not there" if absent else ""
    told = f"{fetched} artifacts fetched from {remote.redacted}, {size / 1e6:.1f} MB; {present} were here already"
    print(told + missing)
    return 0


def _fetch(store: Store, remote: RemoteStore, name: str, fingerprint: str) -> Artifact | None:
    with store.lock_of(name, fingerprint):
        return remote.fetch(name, fingerprint, store)


def _recipes(words: list[str]) -> set[tuple[str, str]] | None:
    """(step, fingerprint) of everything the run of these words is made of; None without words: no choice made."""
    if not words:
        return None
    from pipelines.planning.plan import steps_of_words

    return {(step.name, step.fingerprint) for step in steps_of_words(words)}
