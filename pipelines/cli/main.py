"""The ``rtgs`` command: run, plan, check, outline, show, view, export, report, dashboard, and what they need."""

from __future__ import annotations

import argparse
import difflib
import errno
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType

from pipelines.cli.termination import EXIT_CODE, Terminated, sigterm_raises
from rtgs.core.credentials import redact, words_without_credentials
from rtgs.core.errors import RtgsError
from rtgs.core.version import VERSION

USAGE = f"""rtgs {VERSION}: Gaussian models of scenes with glass and mirrors, on the CPU

  rtgs run [group=choice] [key=value]     train, render, measure, report; what is cached is not run again
  rtgs run synthesize scene=NAME|all      path-trace a described scene into a capture with known truth
  rtgs plan [--multirun] [key=value]      what `rtgs run` with the same words would do, and why
  rtgs explain [KEY] [key=value]          what a key means, its value and default, where it is set
  rtgs figures [NAME] [key=value]         the paper's pictures as panels, from runs that are in the store
  rtgs get [NAME] [to=FOLDER]             real captures by name: download, compare digests, go on where it stopped
  rtgs check FOLDER | scene=NAME | data=  what is wrong with a capture, before any training
  rtgs outline FOLDER | VIDEO             poses, and a page on which you outline the glass in a few photos
  rtgs report [RUN]                       where the report of the latest (or the named) run is
  rtgs show [RUN] [path=] [layer=]        films and pictures of a run from anywhere, layer by layer
  rtgs show FILE.ply [--scene NAME]       pictures of any Gaussian splat; with a scene, measured on its test views
  rtgs view [RUN]                         a run in the browser, its layers as switches; of one in training: view=true
  rtgs export [RUN] [format=]             a run for other programs: ply spz glb html ...
  rtgs cache ls|gc|verify|push|pull       the artifact store, and the one that machines share
  rtgs weights status                     pretrained files: what is known, what is there; downloads nothing
  rtgs dashboard                          MLflow's pages on this machine
  rtgs completion bash|zsh|fish           completion of all this with Tab

  rtgs COMMAND --help tells more. RTGS_DEBUG=1 shows tracebacks."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help", "help"):
        print(USAGE)
        return 0 if words else 2
    if words[0] == "--version":
        print(VERSION)
        return 0
    command = (COMMANDS | HIDDEN).get(words[0])
    if command is None:
        print(f"rtgs: {_unknown(words[0])}", file=sys.stderr)
        return 2
    # Threads of torch that wait by spinning starve each other and the core as soon as a machine has anything else to do
    # (measured: ten times slower under load); must be set before torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    try:
        with sigterm_raises():
            return command(words_without_credentials(words[1:]))
    except Terminated:
        print("\nrtgs: terminated; the same command goes on from the last checkpoint", file=sys.stderr)
        return EXIT_CODE
    except KeyboardInterrupt as ended:
        print(
            f"\nrtgs: {str(ended) or 'interrupted'}; the same command goes on from the last checkpoint", file=sys.stderr
        )
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        return report_error(error)


def _unknown(word: str) -> str:
    """What to say of a command that there is not."""
    close = difflib.get_close_matches(word, COMMANDS, n=1)
    if close:
        return f"unknown command {word!r}: did you mean `rtgs {close[0]}`?"
    hint = "; to train on a folder: rtgs run FOLDER" if Path(word).exists() else ""
    return f"unknown command {word!r}{hint}\n\n{USAGE}"


def report_error(error: Exception) -> int:
    """Print an error: one message where the user can mend it, a traceback where the program is at fault."""
    if os.environ.get("RTGS_DEBUG") or not is_for_users(error):
        text = "".join(traceback.format_exception(error)).rstrip()
    else:
        text = f"rtgs: {_message(error)}"
    print(redact(text), file=sys.stderr)
    return 1


def _message(error: Exception) -> str:
    from rtgs.config.explain import explain, explain_yaml

    if _package(error) == "yaml":
        return explain_yaml(error)
    if _of_config(error):
        return explain(error)
    inner = getattr(error, "error", error)
    if _disk_is_full(inner):
        return f"{error}; free some space, then the same command goes on where it was"
    if _system_error(inner) in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{error}; make it writable, or choose another folder for store and runs with RTGS_ROOT or paths.root"
    if _memory_is_full(inner):
        return (
            f"{error}; there is not enough memory: smaller views (scene.long_side=800), fewer Gaussians "
            "(density.max_surfels=...), or fewer runs at a time; the same command goes on from the last checkpoint"
        )
    return str(error)


def _memory_is_full(error: BaseException) -> bool:
    """Python's own, and what torch says of its allocator."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "DefaultCPUAllocator" in str(error))


def _disk_is_full(error: BaseException) -> bool:
    """Full, or a quota or a limit on the size of files is reached."""
    return _system_error(error) in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) or "No space left on device" in str(error)


def _system_error(error: BaseException) -> int | None:
    """Number of the system's error, also where a library written in Rust (safetensors) only says it; None: no such."""
    if isinstance(error, OSError):
        return error.errno
    said = re.search(r"\(os error (\d+)\)", str(error))
    return int(said.group(1)) if said else None


def is_for_users(error: BaseException) -> bool:
    """Whether the message of an error is meant for users: our own types, values our code refused, the disk."""
    inner = getattr(error, "error", error)  # what a step raised
    if isinstance(inner, (RtgsError, OSError)) or _package(inner) in ("rtgs", "hydra", "omegaconf", "yaml"):
        return True
    if _memory_is_full(inner):
        return True
    if _disk_is_full(inner) or _system_error(inner) is not None:
        return True
    return isinstance(inner, (ValueError, TypeError)) and _raised_in_project(inner.__traceback__)


def _of_config(error: BaseException) -> bool:
    return _package(error) in ("hydra", "omegaconf")


def _package(error: BaseException) -> str:
    return type(error).__module__.split(".")[0]


def _raised_in_project(trace: TracebackType | None) -> bool:
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and trace.tb_frame.f_globals.get("__name__", "").split(".")[0] in ("rtgs", "pipelines")


def run(words: list[str]) -> int:
    """``rtgs run``: everything after it goes to Hydra."""
    if words[:1] == ["synthesize"]:
        from pipelines.cli.synthesize import run_synthesize

        run_synthesize(words[1:])
        return 0
    from pipelines.cli.hydra_run import run_hydra

    run_hydra(words)
    return 0


def plan(words: list[str]) -> int:
    """``rtgs plan``: the steps of a run or of a sweep, cached or not, and why not."""
    from pipelines.cli.plan import HELP, plan_of_words

    if words[:1] in (["-h"], ["--help"]):
        print(HELP)
        return 0
    return plan_of_words(words)


def figures(words: list[str]) -> int:
    """``rtgs figures``: panels of pictures from cached runs."""
    from pipelines.cli.figures import HELP, figures_of_words

    if words[:1] in (["-h"], ["--help"]):
        print(HELP)
        return 0
    return figures_of_words(words)


def cache(words: list[str]) -> int:
    """``rtgs cache ls | gc | verify | push | pull``."""
    from pipelines.cli.cache import main as run_cache

    return run_cache(words, _root())


def check(words: list[str]) -> int:
    """``rtgs check``: everything wrong with a capture; exit code 1 when it cannot be trained on."""
    if not words or words[0] in ("-h", "--help"):
        print("rtgs check FOLDER | scene=NAME [scene.key=value] | data=ref_real|nu_nerf [scene=NAME,...]\n")
        print(
            "Lists what is wrong with a capture; reads every photo, mask and normal map. data: which scenes of a paper"
        )
        print("are in DATA_ROOT, and where what is missing belongs.")
        return 0 if words else 2
    if words[0].startswith("data="):
        from pipelines.planning.datasets import check_dataset

        if unknown := [word for word in words[1:] if not word.startswith("scene=")]:
            raise RtgsError(f"rtgs check data=...: {unknown[0]!r} is not understood; only scene=NAME,... may follow")
        only = [name for word in words[1:] for name in word.removeprefix("scene=").split(",")]
        return check_dataset(words[0].removeprefix("data="), only)
    from rtgs.config import compose
    from rtgs.config.words import friendly_overrides, is_override, quoted
    from rtgs.prepare.source import check_source

    first = words[0] if is_override(words[0]) else f"scene.path={quoted(words[0])}"
    config, _ = compose(friendly_overrides([first, *words[1:]]))
    findings = check_source(config.scene, config.sfm, config.masks)
    errors = sum(finding.severity == "error" for finding in findings)
    for finding in findings:
        print(f"{finding.severity}: {finding.message}")
    verdict = f"{errors} errors: not ready for training" if errors else "ready for training"
    print(f"{config.scene.name}: {len(findings)} findings, {verdict}")
    return 1 if errors else 0


def outline(words: list[str]) -> int:
    """``rtgs outline``: a page on which the glass is outlined."""
    from pipelines.cli.outline import outline as command

    return command(words)


def weights(words: list[str]) -> int:
    """``rtgs weights``: pretrained files by name."""
    parser = argparse.ArgumentParser("rtgs weights", description="Pretrained files; nothing is downloaded.")
    parser.add_argument("action", nargs="?", choices=("status",), default="status", help="what is known, what is there")
    parser.parse_args(words)
    from rtgs.core.files import sha256_of
    from rtgs.prepare.pretrained import REGISTRY
    from rtgs.pretrained.weights import weight_folders, weights_report

    for status in weights_report(files=REGISTRY.values()):
        file = status.file
        digest = file.sha256 or "not registered" + (f", yours is {sha256_of(status.path)}" if status.path else "")
        print(f"{file.name}: {file.used_for}")
        print(f"  file     {file.filename}, {file.megabytes:g} MB, sha256 {digest}")
        print(f"  state    {f'present at {status.path}' if not status.problem else 'absent or wrong'}")
        print(f"  licence  {file.licence}")
        print(f"  source   {file.source}")
        if file.export:
            print(f"  made by  {file.export}")
        if status.path is not None and status.problem:
            print(f"  problem  {status.problem}")
    print("\nfolders searched, the first that has the file wins (RTGS_WEIGHTS names one more):")
    for folder in weight_folders():
        print(f"  {folder}")
    return 0


def report(words: list[str]) -> int:
    """``rtgs report``: print where the page is, and open it on request."""
    parser = argparse.ArgumentParser("rtgs report", description="The report of the latest or the named run.")
    parser.add_argument("run", nargs="?", help="name of a folder in runs/ (default: the run that finished last)")
    parser.add_argument("--root", type=Path, default=_root(), help="folder that holds runs/ (default: %(default)s)")
    parser.add_argument("--open", action="store_true", help="open it in the browser")
    options = parser.parse_args(words)
    from pipelines.publishing.results import report_page
    from rtgs.runs.record import find_run
    from rtgs.workflow import Store

    page = report_page(find_run(options.root / "runs", options.run), Store(options.root / "store"))
    print(page)
    if options.open:
        import webbrowser

        webbrowser.open(page.absolute().as_uri())
    return 0


def dashboard(words: list[str]) -> int:
    """``rtgs dashboard``: MLflow's own server on the loopback address."""
    parser = argparse.ArgumentParser("rtgs dashboard", description="MLflow's pages on http://127.0.0.1:PORT.")
    parser.add_argument("--root", type=Path, default=_root(), help="folder that holds mlflow.db (default: %(default)s)")
    parser.add_argument("--port", type=int, default=5000)
    options = parser.parse_args(words)
    from pipelines.cli.dashboard import serve

    return serve(options.root, options.port)


def _root() -> Path:
    return Path(os.environ.get("RTGS_ROOT", "."))


def show(words: list[str]) -> int:
    """``rtgs show``: a run from anywhere, or any splat as pictures, and measured."""
    from pipelines.cli.show import show as command

    return command(words, _root())


def view(words: list[str]) -> int:
    """``rtgs view``: a run in the browser."""
    from pipelines.cli.view_run import HELP, view_run

    if words[:1] in (["-h"], ["--help"]):
        print(HELP)
        return 0
    return view_run(words, _root())


def get(words: list[str]) -> int:
    """``rtgs get``: public captures by name."""
    from pipelines.cli.get import get as command

    return command(words)


def export(words: list[str]) -> int:
    """``rtgs export``: a run as files for other programs."""
    from pipelines.cli.export import export as command

    return command(words, _root())


def explain(words: list[str]) -> int:
    """``rtgs explain``: what a key means, and who set it."""
    from pipelines.cli.explain import explain as command

    return command(words)


def completion(words: list[str]) -> int:
    """``rtgs completion``: what a shell loads to complete words."""
    from pipelines.cli.complete import completion as command

    return command(words)


def complete(words: list[str]) -> int:
    """``rtgs complete``: what the shells ask with every Tab."""
    from pipelines.cli.complete import complete as possible

    print("\n".join(possible(words, list(COMMANDS), _root())))
    return 0


COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "run": run,
    "plan": plan,
    "figures": figures,
    "cache": cache,
    "get": get,
    "check": check,
    "outline": outline,
    "show": show,
    "view": view,
    "export": export,
    "weights": weights,
    "report": report,
    "dashboard": dashboard,
    "explain": explain,
    "completion": completion,
}
HIDDEN: dict[str, Callable[[list[str]], int]] = {"complete": complete}
