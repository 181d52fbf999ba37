"""The guard itself, on a toy project and on every file of this one. The kept lock: tests/pipelines/test_sources.py."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from pipelines.planning.graph import KINDS
from rtgs.core.errors import RtgsError
from rtgs.workflow import StepKind
from rtgs.workflow.closure import SourceTree
from rtgs.workflow.sources import SourceLock, accept_sources, check_sources
from tests.pipelines.accept_steps import ROOT, project

# What `rtgs get` lists; pages of `rtgs export` and of `rtgs outline`.
OF_NO_STEP = ("rtgs/fetch/captures/", "rtgs/export/web/", "rtgs/prepare/masks/outline.html")
HELD_BY_RECIPES = ("rtgs/scenes/data/",)  # captures: the recipe of an import holds the digest of their files
NOT_READ = (".pyi", ".so", ".pyd", ".pyc", ".typed")


TOY = {
    "guarded/__init__.py": "",
    "guarded/step.py": (
        '"""Doc."""\n\nfrom __future__ import annotations\n\nfrom typing import TYPE_CHECKING\n\n'
        "from guarded.tools import border\n\nif TYPE_CHECKING:\n    from guarded.types import Thing\n\n\n"
        "def work(params, context):\n    from guarded.late import value\n\n    return value, border, 1  # one\n"
    ),
    "guarded/types.py": "class Thing: ...\n",
    "guarded/late.py": "import importlib\n\nvalue = importlib.import_module('guarded.plugin').VALUE\n",
    "guarded/plugin.py": "VALUE = 5\n",
    "guarded/aside.py": "VALUE = 6\n",
    "guarded/tools/__init__.py": "from .border import border\n",
    "guarded/tools/border.py": "from ..kernels import core\n\nborder = 3\n",
    "guarded/kernels/__init__.py": 'core = 0\nREACHES = ("**/*.cpp", "*.cmake", "../../CMakeLists.txt")\n',
    "guarded/kernels/deep/kernel.cpp": (
        '// One.\nfloat f() { return 1.f; }  /* two\n lines */\nconst char* g = "a//b";\n'
    ),
    "guarded/kernels/build.cmake": "# Flags.\nset(FLAGS -O3)\n",
    "CMakeLists.txt": "project(guarded)  # a name\n",
}


@pytest.fixture
def toy(tmp_path: Path, monkeypatch) -> Path:
    """A small project with a step; its folder."""
    for name, text in TOY.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in [name for name in sys.modules if name.split(".")[0] == "guarded"]:
        del sys.modules[name]


@pytest.fixture
def kind(toy: Path) -> StepKind:
    import guarded.step  # pyright: ignore[reportMissingImports]

    return StepKind("guarded", 1, guarded.step.work)


def problems(kind: StepKind, toy: Path) -> list[str]:
    """What a check says after a first look at the toy project in ``lock.json``."""
    return check_sources([kind], toy / "lock.json", SourceTree(toy, ["guarded"]))


def test_a_step_reaches_what_its_imports_can_run(toy: Path):
    reached = SourceTree(toy, ["guarded"]).closure("guarded.step")
    assert reached == TOY.keys() - {"guarded/types.py", "guarded/aside.py"}


@pytest.mark.parametrize("file", sorted(TOY.keys() - {"guarded/types.py", "guarded/aside.py"}))
def test_a_change_anywhere_is_caught_and_named(kind: StepKind, toy: Path, file: str):
    lock = toy / "lock.json"
    accept_sources([kind], lock, SourceTree(toy, ["guarded"]))
    assert problems(kind, toy) == []
    statement = {".cpp": "int more;\n", ".cmake": "set(MORE 1)\n", ".txt": "set(MORE 1)\n"}
    with (toy / file).open("a") as stream:
        stream.write(statement.get(Path(file).suffix, "MORE = 1\n"))
    assert problems(kind, toy) == [
        f"source of step guarded changed (changed: {file}): bump version or run `make accept-steps`"
    ]


def test_files_that_come_and_go_are_named(kind: StepKind, toy: Path):
    accept_sources([kind], toy / "lock.json", SourceTree(toy, ["guarded"]))
    (toy / "guarded/late.py").write_text("import importlib\n\nvalue = importlib.import_module('guarded.aside').VALUE\n")
    assert problems(kind, toy) == [
        "source of step guarded changed (changed: guarded/late.py; new: guarded/aside.py; gone: guarded/plugin.py): "
        "bump version or run `make accept-steps`"
    ]


def test_comments_blanks_and_docstrings_do_not_count(kind: StepKind, toy: Path):
    accept_sources([kind], toy / "lock.json", SourceTree(toy, ["guarded"]))
    step = toy / "guarded/step.py"
    step.write_text(step.read_text().replace('"""Doc."""', '"""New."""').replace("# one", "# two\n\n"))
    (toy / "guarded/plugin.py").write_text('VALUE = 5\n"""What it is."""\n')
    (toy / "guarded/kernels/deep/kernel.cpp").write_text(
        'float f() {\n  return 1.f;\n}\nconst char* g = "a//b"; // Two\n'
    )
    (toy / "guarded/kernels/build.cmake").write_text("set(FLAGS\n  -O3)\n")
    (toy / "guarded/types.py").write_text("class Other: ...\n")
    assert problems(kind, toy) == []
    (toy / "guarded/kernels/deep/kernel.cpp").write_text('float f() { return 1.f; }\nconst char* g = "a//c";\n')
    assert len(problems(kind, toy)) == 1


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('const char* a = "x  y";\n', 'const char* a = "x y";\n'),
        ('char q = \'"\'; const char* a = "x//y";\n', 'char q = \'"\'; const char* a = "x//z";\n'),
        ('const char* a = R"(say "x//y")";\n', 'const char* a = R"(say "x//z")";\n'),
        ("#define A 1\nint b;\n", "#define A 1 int b;\n"),
        ("#define A \\\n  1\nint b;\n", "#define A \\\n  2\nint b;\n"),
    ],
)
def test_what_only_looks_like_a_comment_or_a_blank_counts(kind: StepKind, toy: Path, before: str, after: str):
    kernel = toy / "guarded/kernels/deep/kernel.cpp"
    kernel.write_text(before)
    accept_sources([kind], toy / "lock.json", SourceTree(toy, ["guarded"]))
    kernel.write_text(after)
    assert len(problems(kind, toy)) == 1


def test_versions_are_recorded_and_steps_come_and_go(kind: StepKind, toy: Path):
    lock, tree = toy / "lock.json", SourceTree(toy, ["guarded"])
    assert check_sources([kind], lock, tree) == ["step guarded is new: run `make accept-steps`"]
    accept_sources([kind], lock, tree)
    bumped = replace(kind, version=2)
    assert check_sources([bumped], lock, tree) == ["version of step guarded is 2, recorded 1: run `make accept-steps`"]
    accept_sources([bumped], lock, tree)
    assert check_sources([bumped], lock, tree) == []
    assert check_sources([], lock, tree) == ["step guarded is gone: run `make accept-steps`"]


def test_the_lock_says_the_same_when_it_is_read_again(toy: Path, kind: StepKind):
    lock = SourceLock.of([kind], SourceTree(toy, ["guarded"]))
    lock.write(toy / "lock.json")
    assert SourceLock.read(toy / "lock.json") == lock


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("import importlib\nname = 'guarded.aside'\nimportlib.import_module(name)\n", r"line 3, import_module"),
        ("from importlib import import_module as bring\nbring('guarded.aside')\n", r"line 1, from importlib"),
        ("def late(names):\n    return [__import__(name) for name in names]\n", r"line 2, __import__"),
        ("from importlib import import_module\nfound = list(map(import_module, ()))\n", r"line 2, import_module"),
        ("import importlib\nimportlib.import_module('.aside', 'guarded')\n", r"line 2, import_module"),
        ("from importlib.metadata import entry_points\n", r"line 1, entry_points"),
        ("from pathlib import Path\nTABLE = (Path(__file__).parent / 'table.csv')\n", r"line 2, __file__"),
        ("from importlib import resources\n", r"line 1, importlib.resources"),
        ("from guarded.aside import *\n", r"line 1, from guarded.aside import \*"),
        ("import importlib.resources\nimportlib.resources.files('guarded')\n", r"line 1, importlib.resources"),
        ("from importlib_resources import files\n", r"line 1, importlib.resources"),
        ("import importlib\ngetattr(importlib, 'import_module')('guarded.aside')\n", r"line 2, import_module"),
        ("import importlib\ngetattr(importlib, 'import_' + 'module')('x')\n", r"line 2, getattr\(importlib, ...\)"),
        ("def late(text):\n    exec(text)\n", r"line 2, exec"),
        ("import pkgutil\npkgutil.resolve_name('guarded.aside')\n", r"line 2, resolve_name"),
        ("import guarded\nfound = list(guarded.__path__)\n", r"line 2, __path__"),
        ("import ctypes\nkernel = ctypes.CDLL('kernel.so')\n", r"line 2, CDLL"),
    ],
)
def test_what_imports_do_not_show_must_be_declared(kind: StepKind, toy: Path, text: str, why: str):
    (toy / "guarded/plugin.py").write_text(text)
    with pytest.raises(RtgsError, match=rf"guarded/plugin\.py, {why}.*REACHES = "):
        problems(kind, toy)
    (toy / "guarded/plugin.py").write_text(text + "REACHES = ()\n")
    without = SourceTree(toy, ["guarded"]).closure("guarded.step")
    (toy / "guarded/table.csv").write_text("1,2\n")
    (toy / "guarded/more").mkdir()
    (toy / "guarded/more/__init__.py").write_text("")
    (toy / "guarded/more/one.py").write_text("import guarded.types\n")
    (toy / "guarded/plugin.py").write_text(text + 'REACHES = ("*.csv", "guarded.more.*")\n')
    more = {"guarded/table.csv", "guarded/more/__init__.py", "guarded/more/one.py", "guarded/types.py"}
    assert SourceTree(toy, ["guarded"]).closure("guarded.step") == without | more


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import guarded.nothing\n", r"reaches the module 'guarded.nothing', which does not exist"),
        ('REACHES = ("*.toml",)\n', r"declares '\*\.toml' in REACHES: there is no such file"),
        ('REACHES = ("guarded.nothing",)\n', r"the module 'guarded.nothing', which does not exist"),
        ("REACHES = tuple(range(3))\n", r"REACHES must be a literal tuple of strings"),
    ],
)
def test_what_does_not_exist_is_named(kind: StepKind, toy: Path, text: str, message: str):
    (toy / "guarded/plugin.py").write_text(text)
    with pytest.raises(RtgsError, match=message):
        problems(kind, toy)


def test_a_step_from_nowhere_is_named(toy: Path):
    elsewhere = StepKind("elsewhere", 1, partial(print))
    elsewhere.run.__module__ = "nowhere.step"  # pyright: ignore
    with pytest.raises(RtgsError, match=r"step elsewhere reaches the module 'nowhere.step'"):
        check_sources([elsewhere], toy / "lock.json", SourceTree(toy, ["guarded"]))


# The project itself.


@pytest.fixture(scope="module")
def tree() -> SourceTree:
    return project()


@pytest.fixture(scope="module")
def lock(tree: SourceTree, tmp_path_factory) -> Path:
    """A lock file of the project as it is now, accepted or not."""
    file = tmp_path_factory.mktemp("lock") / "steps.lock.json"
    accept_sources(KINDS, file, tree)
    return file


def steps_named(tree: SourceTree, lock: Path, file: str, text: str) -> tuple[str, ...]:
    """The steps that a check names when one file has another text; each must name the file."""
    found = check_sources(KINDS, lock, tree.edited(file, text))
    assert all(f"(changed: {file})" in problem for problem in found)
    return tuple(sorted(problem.split()[3] for problem in found))


def test_one_more_line_in_any_file_names_the_steps_that_reach_it(tree: SourceTree, lock: Path):
    """Every module, kernel and template of every step; and a comment or docstring more names none."""
    statements = {".py": "_MUTATED = 1", ".cpp": "int mutated;", ".h": "int mutated;", ".cmake": "set(MUTATED 1)"}
    comments = {".py": "# Mutated.", ".cpp": "// Mutated.", ".h": "/* Mutated. */", ".cmake": "# Mutated."}
    sources = SourceLock.read(lock).sources
    assert len(sources) > 250
    assert {Path(file).suffix for file in sources} >= {".py", ".cpp", ".h", ".cmake", ".html", ".css", ".js", ".toml"}
    for file, (_, steps) in sources.items():
        text, suffix = tree.text(file), ".cmake" if file == "CMakeLists.txt" else Path(file).suffix
        assert steps_named(tree, lock, file, f"{text}\n{statements.get(suffix, 'mutated')}\n") == steps, file
        if suffix in comments:
            assert steps_named(tree, lock, file, f"{comments[suffix]}\n{text}\n\n{comments[suffix]}\n") == (), file


def test_another_number_in_a_source_is_seen(tree: SourceTree, lock: Path):
    """In a module that is loaded late, in a kernel, in a build flag, in a described scene."""
    for file, old, new in (
        ("rtgs/optics/reflection.py", "return", "return 2 *"),
        ("rtgs/native/trace/forward.cpp", "return", "return 2 *"),
        ("rtgs/native/native.cmake", "-O3", "-O2"),
        ("rtgs/scenes/synthetic/scenes/ball_statue.toml", "turn = 50.0", "turn = 51.0"),
    ):
        text = tree.text(file)
        assert old in text
        assert len(steps_named(tree, lock, file, text.replace(old, new, 1))) > 0, file


def test_steps_reach_what_they_are_known_to_use(tree: SourceTree, lock: Path):
    """Known by hand, so that a closure that is empty or everything does not pass."""
    steps = {file: set(steps) for file, (_, steps) in SourceLock.read(lock).sources.items()}
    trained = {"train_diffuse", "train_reflection", "train_transmittance"}
    assert all(len(reaching) < len(KINDS) for file, reaching in steps.items() if file.startswith("rtgs/native/"))
    for file in ("rtgs/native/raster/forward.cpp", "CMakeLists.txt"):
        assert steps[file] >= trained | {"render", "extract_mesh"}
    for file in ("rtgs/optics/reflection.py", "rtgs/optics/light.py"):
        assert steps[file] >= {"train_reflection", "train_transmittance", "render"}
    for file in ("rtgs/native/raster/forward.cpp", "rtgs/optics/light.py", "rtgs/report/page.py"):
        assert not steps[file] & {"import_scene", "sfm", "normals", "synthesize"}, file
    assert steps["rtgs/report/templates/report.html"] >= {"report"}
    assert not steps["rtgs/report/templates/report.html"] & {"import_scene", "sfm", "masks", "synthesize"}
    assert steps["rtgs/prepare/poses/sfm.py"] == {"sfm"}
    assert "evaluate" in steps["rtgs/scenes/synthetic/scenes/ball_statue.toml"]
    assert all(len(reaching) == len(KINDS) for file, reaching in steps.items() if file == "rtgs/workflow/step.py")


def test_every_file_that_is_no_module_is_reached_by_a_step(lock: Path):
    """A table or template beside the modules is not forgotten."""
    others = {
        path.relative_to(ROOT).as_posix()
        for package in ("rtgs", "pipelines", "hydra_plugins")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix not in (".py", *NOT_READ)
    }
    others = {file for file in others if not file.startswith((*HELD_BY_RECIPES, *OF_NO_STEP))}
    assert len(others) > 60
    assert sorted(others - SourceLock.read(lock).sources.keys()) == []
