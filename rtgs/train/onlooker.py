"""Somebody who watches a training and may pause or end it; nothing of its result depends on them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from rtgs.train.progress import Progress

if TYPE_CHECKING:
    from rtgs.mesh.container import ObjectMesh
    from rtgs.scenes.scene import Scene
    from rtgs.train.method import Method


class Onlooker(Progress, Protocol):
    """Is told how far a training is, and looks at the method between two steps; that is no time of training."""

    def attend(self, scene: Scene, mesh: ObjectMesh | None, progress: Progress) -> None:
        """Before a training begins: what it is of, and where a line for the user can be put."""
        ...

    def look(self, method: Method, step: int) -> bool:
        """After ``step`` steps; leaves the method as it is. True: the training ends here, after a checkpoint."""
        ...


class TrainingStopped(KeyboardInterrupt):
    """Somebody asked for the end of a training; what Ctrl-C would leave is left, with a checkpoint of this step."""

    def __init__(self, step: int) -> None:
        super().__init__(f"stopped at step {step}")
        self.step = step
