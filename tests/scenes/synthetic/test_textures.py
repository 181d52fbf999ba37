import numpy as np
import pytest

from rtgs.scenes.synthetic.description import TEXTURES, Material
from rtgs.scenes.synthetic.textures import texture


@pytest.mark.parametrize("name", TEXTURES)
def test_reflectance_is_physical_repeatable_and_has_something_to_hold_on_to(name):
    material = Material(texture=name, color=(0.6, 0.3, 0.2), color2=(0.1, 0.2, 0.4))
    picture = texture(material, seed=3, size=128)
    assert picture.shape == (128, 128, 3)
    assert 0 <= picture.min() <= picture.max() <= 1
    np.testing.assert_array_equal(picture, texture(material, seed=3, size=128))
    assert np.abs(np.diff(picture, axis=1)).mean() > 5e-4
    assert not np.array_equal(picture, texture(material, seed=4, size=128))


def test_pictures_stand_upright_first_row_below():
    window = texture(Material(texture="window", color=(0.2, 0.4, 1.0), color2=(0, 0, 0)), seed=0)
    assert window[330:490].mean() > 1.3 * window[20:150].mean()  # sky above hills and houses


def test_a_glowing_shape_has_its_own_picture():
    material = Material(texture="plain", color=(0.2, 0.4, 1.0), color2=(0, 0, 0))
    glow = texture(material, seed=0, name="window")
    np.testing.assert_array_equal(glow, texture(Material(texture="window", color=(0.2, 0.4, 1.0), color2=(0, 0, 0)), 0))


def test_unknown_texture_is_said():
    with pytest.raises(ValueError, match="unknown texture 'velvet'"):
        texture(Material(texture="velvet"), seed=0)
