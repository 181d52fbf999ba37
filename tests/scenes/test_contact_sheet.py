"""The contact sheet shows every layer of every capture."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.scenes.contact_sheet import COLUMNS, cells, contact_sheet
from rtgs.scenes.scene import View
from rtgs.scenes.settings import CaptureError
from rtgs.scenes.truth import ViewTruth


def flat_view() -> tuple[View, ViewTruth]:
    """A wall at depth 2 that faces the camera, half of it missing; light of three known levels."""
    height, width = 12, 16
    known = torch.zeros(height, width, dtype=torch.bool)
    known[:, :8] = True
    normal = torch.zeros(3, height, width)
    normal[2] = -1.0 * known
    light = {name: torch.full((3, height, width), level) for name, level in
             (("diffuse", 0.2), ("reflected", 0.0), ("transmitted", 0.5))}  # fmt: skip
    truth = ViewTruth(2.0 * known, 3.0 * known, normal, known.short() - 1, known, **light)
    camera = Camera(torch.eye(3).double(), torch.zeros(3).double(), 10.0, 10.0, 8.0, 6.0, width, height, name="v")
    return View(camera, torch.full((3, height, width), 0.25), known, None, "v", truth), truth


def test_cells_show_what_their_column_says():
    view, truth = flat_view()
    shown = dict(zip(COLUMNS, cells(view, truth)))
    assert all(picture.shape == (12, 16, 3) for picture in shown.values())
    np.testing.assert_allclose(shown["image"], 0.25)
    np.testing.assert_array_equal(shown["mask"][..., 0], truth.specular.numpy())
    np.testing.assert_allclose(shown["normal"][:, :8], np.broadcast_to((0.5, 0.5, 1.0), (12, 8, 3)))  # bluish: faces us
    assert (shown["normal"][:, 8:] == 0).all()
    assert (shown["depth"][:, :8] > 0).all()
    assert (shown["depth"][:, 8:] == 0).all()
    assert shown["diffuse"].mean() == pytest.approx(0.4845, abs=1e-3)  # sRGB of 0.2
    assert shown["reflected"].max() == 0
    assert (cells(replace(view, mask=None), truth)[1] == 0).all()


def test_no_captures_is_an_error():
    with pytest.raises(CaptureError, match="none is shipped"):
        contact_sheet([])
