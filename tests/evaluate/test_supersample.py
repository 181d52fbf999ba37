"""Finer pictures, averaged."""

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.evaluate.records import EvaluationTable, RunFacts, ViewScore, read_json, write_json
from rtgs.evaluate.settings import EvaluationSettings
from rtgs.evaluate.supersample import supersampled
from rtgs.scenes.images import area_resize

CAMERA = Camera(torch.eye(3), torch.zeros(3), 10.0, 12.0, 4.0, 3.0, 8, 6)


def stripes(camera: Camera, mask: Tensor | None) -> Tensor:
    """Columns of rays: what a picture shows at x / z, brighter than a photo can hold at the right."""
    x = camera.camera_rays()[..., 0]
    return (2 * x + 0.7).expand(3, *x.shape).contiguous()


@pytest.mark.parametrize("times", [2, 3])
def test_as_a_finer_photo_made_smaller(times: int):
    fine = CAMERA.resized(8 * times, 6 * times)
    photo = stripes(fine, None).clamp(0, 1).permute(1, 2, 0).numpy()
    small = torch.from_numpy(area_resize(photo, 8, 6)).permute(2, 0, 1)
    torch.testing.assert_close(supersampled(stripes, CAMERA, None, times), small, rtol=1e-5, atol=1e-6)


def test_once_is_the_picture_itself():
    assert torch.equal(supersampled(stripes, CAMERA, None, 1), stripes(CAMERA, None))


def test_masks_are_repeated():
    mask = torch.rand(6, 8) > 0.5
    seen = supersampled(lambda camera, fine: fine.float().expand(3, -1, -1), CAMERA, mask, 2)  # type: ignore[union-attr]
    assert torch.equal(seen[0], mask.float())


def test_the_setting_and_what_tables_say(tmp_path):
    with pytest.raises(RtgsError, match=r"evaluation\.supersample=0"):
        EvaluationSettings(supersample=0)
    row = ViewScore("a", 8, 6, None, {"psnr": 20.0})
    plain = EvaluationTable(RunFacts("s", "m"), (row,))
    finer = EvaluationTable(RunFacts("s", "m", supersample=2), (row,))
    assert plain.resolution == "8x6"
    assert finer.resolution == "8x6, 2x2 samples a pixel"
    for name, table in (("plain", plain), ("finer", finer)):
        write_json(tmp_path / name, table)
        assert read_json(tmp_path / name).facts == table.facts
    assert "supersample" not in (tmp_path / "plain").read_text()
