"""Completion of the command line in bash, zsh and fish: ``rtgs completion SHELL`` prints what a shell loads.

The shells ask ``rtgs complete WORDS``: the words before the cursor, the last one unfinished. It answers with one
possible word a line, and with :data:`FILES` where any file may stand. It composes nothing, so that it is quick.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rtgs.core.errors import RtgsError

SHELLS = ("bash", "zsh", "fish")
FILES = "<files>"
_OF_RUNS = ("run", "plan", "explain")  # commands that take words of a run
_GROUPS = ("scene", "method", "preset", "ablation", "judge", "experiment", "sfm", "masks", "normals", "tracking")
_OF_COMMANDS = {
    "show": ("path=", "layer=", "frames=", "fps=", "size=", "format=", "transform=", "out=", "threads=", "root="),
    "view": ("host=", "port=", "long_side=", "threads=", "root="),
    "export": ("format=", "steps=", "splats=", "out=", "threads=", "root="),
    "cache": ("ls", "gc", "verify", "push", "pull", "--partial", "--older-than", "--remote", "--root"),
    "check": ("scene=", "data=ref_real", "data=nu_nerf"),
    "outline": ("scene=",),
    "report": ("--open", "--root"),
    "weights": ("status",),
    "dashboard": ("--root", "--port"),
    "completion": SHELLS,
}
_VALUES = {
    "show": {
        "path": ("orbit", "cameras", "spiral"),
        "layer": ("final", "diffuse", "reflection", "transmission", "normal", "depth", "weights", "all"),
        "format": ("png", "mp4", "webp"),
    },
    "export": {"format": ("ply", "compressed_ply", "spz", "sog", "glb", "html")},
}

BASH = """_rtgs() {
    local line word reply cut=''
    local -a candidates=()
    line=${COMP_LINE:0:COMP_POINT}
    local -a words
    read -ra words <<< "$line"
    [[ $line == *' ' ]] && words+=('')
    word=${words[${#words[@]}-1]}
    while IFS= read -r reply; do
        if [[ $reply == '<files>' ]]; then
            compopt -o default 2>/dev/null
        else
            candidates+=("$reply")
        fi
    done < <("${words[0]/#\\~/$HOME}" complete "${words[@]:1}" 2>/dev/null)
    # where '=' parts words, the shell replaces only what follows it
    [[ $COMP_WORDBREAKS == *=* && $word == *=* ]] && cut=${word%"${word##*=}"}
    COMPREPLY=("${candidates[@]#"$cut"}")
    [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *[=./] ]] && compopt -o nospace 2>/dev/null
    [[ ${#COMPREPLY[@]} -gt 1 ]] && compopt -o nospace 2>/dev/null
    return 0
}
complete -F _rtgs rtgs
"""

ZSH = """#compdef rtgs
_rtgs() {
    local -a candidates
    local files=0 reply
    while IFS= read -r reply; do
        if [[ $reply == '<files>' ]]; then files=1; else candidates+=("$reply"); fi
    done < <("${words[1]/#\\~/$HOME}" complete "${(@)words[2,CURRENT]}" 2>/dev/null)
    local -a open closed
    open=(${(M)candidates:#*[=./]})
    closed=(${candidates:#*[=./]})
    (( $#open )) && compadd -Q -S '' -- $open
    (( $#closed )) && compadd -Q -- $closed
    if (( files )); then
        compset -P '*='
        _files
    fi
}
compdef _rtgs rtgs
"""

FISH = """function __rtgs_complete
    set -l words (commandline -opc) (commandline -ct)
    for reply in ($words[1] complete $words[2..-1] 2>/dev/null)
        if test "$reply" = '<files>'
            __fish_complete_path (commandline -ct)
        else
            echo $reply
        end
    end
end
complete -c rtgs -f -a '(__rtgs_complete)'
"""
SCRIPTS = {"bash": BASH, "zsh": ZSH, "fish": FISH}

HELP = """rtgs completion bash|zsh|fish

Prints what the shell needs to complete commands, keys, choices and names of runs with Tab:

  bash   eval "$(rtgs completion bash)"            in ~/.bashrc
  zsh    eval "$(rtgs completion zsh)"             in ~/.zshrc, after compinit
  fish   rtgs completion fish | source             in ~/.config/fish/config.fish"""


def completion(words: Sequence[str]) -> int:
    """``rtgs completion``; returns the exit code.

    Raises:
        RtgsError: no such shell.
    """
    if not words or words[0] in ("-h", "--help"):
        print(HELP)
        return 0 if words else 2
    if words[0] not in SCRIPTS or len(words) > 1:
        raise RtgsError(f"rtgs completion {' '.join(words)}: give one of {', '.join(SHELLS)}")
    print(SCRIPTS[words[0]], end="")
    return 0


def complete(words: Sequence[str], commands: Sequence[str], root: Path) -> list[str]:
    """Words that may stand for the last of ``words``, which follow ``rtgs``.

    Args:
        commands: there are; root: holds ``runs/``.
    """
    if len(words) <= 1:
        return _beginning(words[0] if words else "", sorted(commands))
    command, unfinished = words[0], words[-1]
    if command in ("show", "view", "export", "report"):
        found = [*(_runs(root) if "=" not in unfinished else ()), *_OF_COMMANDS[command]]
        key, equals, _ = unfinished.partition("=")
        if command in _VALUES and equals:
            found = [f"{key}={value}" for value in _VALUES[command].get(key, ())]
        return _beginning(unfinished, found) or ([FILES] if command in _VALUES else [])
    if command == "get" and "=" not in unfinished:
        from rtgs.fetch.catalogue import capture_names

        return _beginning(unfinished, [*capture_names(), "to="])
    found = _beginning(unfinished, _OF_COMMANDS.get(command, ()))
    of_run = command in _OF_RUNS or (command == "cache" and words[1] in ("push", "pull") and len(words) > 2)
    if of_run or (command in ("check", "outline") and unfinished.startswith("scene")):
        found = _words_of_run(unfinished) + (found if command not in _OF_RUNS else [])
    if command == "explain" and unfinished and "=" not in unfinished:
        found = [each.removesuffix("=") for each in found]
    return list(dict.fromkeys(found)) or [FILES]


def _words_of_run(unfinished: str) -> list[str]:
    """Groups, keys level by level, and the choices of a group."""
    from rtgs.config.keys import config_keys, words_of_key
    from rtgs.config.locate import choices_of

    mark = unfinished[: len(unfinished) - len(unfinished.lstrip("+~"))]
    key, equals, value = unfinished[len(mark) :].partition("=")
    if unfinished.startswith("-"):
        return _beginning(unfinished, ("--multirun", "--cfg", "--help"))
    if not equals:
        levels = [f"{group}=" for group in _GROUPS] + [_level(name, key) for name in config_keys()]
        return [mark + each for each in dict.fromkeys(_beginning(key, levels))]
    before, comma, last = value.rpartition(",")
    choices = choices_of(key) if key in _GROUPS else words_of_key(key)
    found = [f"{mark}{key}={before}{comma}{each}" for each in _beginning(last, choices)]
    return found + ([FILES] if key in ("scene", "scene.path") and not found else [])


def _level(name: str, key: str) -> str:
    """A dotted key up to the level after the one that is being typed: ``method.`` before ``method.loss.``."""
    depth = key.count(".") + 1
    parts = name.split(".")
    return f"{name}=" if len(parts) <= depth else ".".join(parts[:depth]) + "."


def _runs(root: Path) -> list[str]:
    return sorted(path.parent.name for path in (root / "runs").glob("*/run.json"))


def _beginning(start: str, words: Sequence[str]) -> list[str]:
    return [word for word in words if word.startswith(start)]
