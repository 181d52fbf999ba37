"""What is read of an artifact is shared by the steps of a run, and by no other run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rtgs.workflow import Artifacts, InlineExecutor, Step, StepContext, Store, make_plan


class Reader:
    """Reads a file and remembers which."""

    def __init__(self) -> None:
        self.read: list[str] = []

    def __call__(self, folder: Path) -> str:
        self.read.append(folder.name)
        return (folder / "text").read_text()


def folder_with(root: Path, name: str) -> Path:
    folder = root / name
    folder.mkdir()
    (folder / "text").write_text(name)
    return folder


def test_each_folder_is_read_once_and_only_the_newest_is_kept(tmp_path: Path) -> None:
    first, second = folder_with(tmp_path, "first"), folder_with(tmp_path, "second")
    reader, other, artifacts = Reader(), Reader(), Artifacts()
    assert [artifacts.read(reader, first) for _ in range(2)] == ["first"] * 2
    assert reader.read == ["first"]
    assert artifacts.read(other, first) == "first"  # another reader makes another thing of it
    assert artifacts.read(reader, second) == "second"
    assert artifacts.read(reader, first) == "first"
    assert reader.read == ["first", "second", "first"]
    assert Artifacts().read(reader, first) == "first"
    assert len(reader.read) == 4


@dataclass(frozen=True)
class Nothing:
    """Parameters of a step without any."""

    number: int = 0


def test_the_steps_of_a_run_share_what_they_read_and_runs_do_not(tmp_path: Path) -> None:
    reader = Reader()

    def write(params: Nothing, context: StepContext) -> None:
        (context.out / "text").write_text("content")

    def read(params: Nothing, context: StepContext) -> None:
        assert context.read("source", reader) == "content"
        assert not context.quiet

    source = Step("source", 1, Nothing(), write)
    readers = [Step(f"reader_{number}", 1, Nothing(number), read, (source,)) for number in range(3)]
    store = Store(tmp_path / "store")
    InlineExecutor(store).execute(make_plan(readers[:2], store))
    assert len(reader.read) == 1
    InlineExecutor(store).execute(make_plan(readers, store))  # only the third is left to run
    assert len(reader.read) == 2
