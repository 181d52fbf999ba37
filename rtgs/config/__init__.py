"""The config: frozen dataclasses as schema, YAML files that hold only differences, Hydra to compose them."""

from rtgs.config.compose import compose
from rtgs.config.convert import to_run_config
from rtgs.config.schema import AblationConfig, Choices, PathsConfig, RunConfig, TrackingConfig, register_schema

__all__ = [
    "AblationConfig",
    "Choices",
    "PathsConfig",
    "RunConfig",
    "TrackingConfig",
    "compose",
    "register_schema",
    "to_run_config",
]
