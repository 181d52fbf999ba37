"""SceneSettings as a config schema, and what importing the scenes package costs."""

from __future__ import annotations

import dataclasses
import logging
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from omegaconf.errors import ConfigKeyError, ValidationError

from rtgs.config.schema import open_schema
from rtgs.core.build import build
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings

from .captures import ColmapCapture


def test_it_is_a_schema_for_structured_configs():
    schema = open_schema(SceneSettings)
    config = OmegaConf.merge(schema, {"name": "ring", "long_side": 400, "background": [1, 1, 1]})
    values = OmegaConf.to_container(config)
    assert isinstance(values, dict)
    assert build(SceneSettings, values) == SceneSettings(name="ring", long_side=400, background=(1.0, 1.0, 1.0))
    with pytest.raises(ConfigKeyError):
        OmegaConf.merge(schema, {"long_sid": 400})
    with pytest.raises(ValidationError):
        OmegaConf.merge(schema, {"long_side": "big"})


def test_every_field_is_documented():
    source = Path(sys.modules[SceneSettings.__module__].__file__ or "").read_text(encoding="utf-8")
    for field in dataclasses.fields(SceneSettings):
        after = source.split(f"    {field.name}: ", 1)[1].splitlines()[1].strip()
        assert after.startswith('"""'), field.name


def test_importing_is_light():
    code = (
        "import sys, rtgs.scenes.scene, rtgs.scenes.canonical, rtgs.scenes.check\n"
        "heavy = {'pycolmap', 'cv2', 'open3d', 'mlflow', 'hydra', 'dask', 'mitsuba', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])


def test_the_import_logs_what_it_decided(tmp_path, caplog):
    root = ColmapCapture(tmp_path, views=5).write()
    with caplog.at_level(logging.INFO):
        scene = load_scene(SceneSettings(name="ring", path=str(root)))
    assert "only 5 photos with a pose" in caplog.text
    assert "ring: 4 training and 1 test views of 64x48, 60 points" in caplog.text
    assert "every 8th view" in scene.source
    assert scene.summary().sizes == ((64, 48),)
    assert not scene.has_masks
    assert not scene.has_normals
