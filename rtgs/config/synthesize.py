"""What ``rtgs run synthesize`` is made of: the schema of ``conf/synthesize.yaml``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

from rtgs.config.compose import without_hydra
from rtgs.config.opened import opened_configs
from rtgs.config.schema import PathsConfig, open_schema
from rtgs.core.build import build
from rtgs.scenes.synthetic.settings import CaptureSettings

SCHEMA_NAME = "synthesize_schema"
SYNTHESIZE_NOTE = "in `rtgs run synthesize`"
"""On an error of its words: which command's keys may be meant."""


@dataclass(frozen=True)
class SynthesizeConfig(CaptureSettings):
    """Settings of the capture, and how and where it is made."""

    variant: str | None = None
    """Of Mitsuba: ``llvm_ad_rgb`` or ``scalar_rgb``. None: the first where LLVM is found, else the second. Does not
    enter the recipe: both give the same pictures up to noise."""
    output: str | None = None
    """Folder that gets a copy of every capture, in a folder of its own with the scene's name. None: the store alone."""
    paths: PathsConfig = field(default_factory=PathsConfig)

    @property
    def capture(self) -> CaptureSettings:
        """What the capture depends on."""
        return CaptureSettings(**{item.name: getattr(self, item.name) for item in fields(CaptureSettings)})


def compose_synthesize(overrides: Sequence[str]) -> SynthesizeConfig:
    """The config of ``rtgs run synthesize <overrides>`` without the scene.

    Raises:
        hydra.errors.HydraException: an override does not fit the schema (its cause names the key).
        RtgsError: a value is out of range.
    """
    from hydra import compose
    from hydra.core.config_store import ConfigStore
    from hydra.errors import HydraException
    from omegaconf import OmegaConf

    ConfigStore.instance().store(name=SCHEMA_NAME, node=open_schema(SynthesizeConfig), provider="rtgs")
    with opened_configs():
        try:
            composed = compose("synthesize", overrides=list(overrides))
        except HydraException as error:
            error.add_note(SYNTHESIZE_NOTE)
            raise
    values = OmegaConf.to_container(without_hydra(composed), resolve=True, throw_on_missing=True)
    assert isinstance(values, dict)
    return build(SynthesizeConfig, {str(key): value for key, value in values.items()})
