# For type checkers: the bindings take torch tensors through DLPack, which nanobind's generated stubs cannot say.
# Shapes and types are checked by the Python function beside each kernel.
from typing import Any

def __getattr__(name: str) -> Any: ...
