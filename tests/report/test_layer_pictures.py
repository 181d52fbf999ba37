"""Layers beside their truth in the report."""

from dataclasses import replace

import torch

from rtgs.core.cameras import Camera
from rtgs.methods.registry import find_method, own_methods
from rtgs.methods.spec import FAR_LIGHT, MIRROR
from rtgs.report.layers import NAMES, layer_pixels
from rtgs.scenes.truth import ViewTruth

SIZE = (32, 48)


def truth(transmitted: float = 0.0) -> ViewTruth:
    normal = torch.zeros(3, *SIZE)
    normal[2] = -1  # towards the camera, in its frame
    light = torch.full((3, *SIZE), 0.2140)
    specular = torch.zeros(SIZE, dtype=torch.bool)
    specular[:, :24] = True
    depth = torch.ones(SIZE)
    objects = torch.zeros(SIZE, dtype=torch.int16)
    return ViewTruth(depth, 2 * depth, normal, objects, specular, light, light / 4, transmitted * light)


def layers() -> dict[str, torch.Tensor]:
    normal = torch.zeros(3, *SIZE)
    normal[2] = -1
    flat = torch.full(SIZE, 0.25)
    colors = {"diffuse": torch.full((3, *SIZE), 0.5), "reflection": torch.zeros(3, *SIZE)}
    return colors | {"normal": normal, "specular": flat, "roughness": flat, "f0": flat}


def camera() -> Camera:
    return Camera(torch.eye(3), torch.zeros(3), 40.0, 40.0, 24.0, 16.0, 48, 32)


def test_each_layer_stands_beside_its_truth():
    photo = torch.rand(3, *SIZE)
    found = {item.title: item for item in layer_pixels(layers(), photo, photo, camera(), truth())}
    assert list(found) == ["Diffuse", "Reflection", "Normal", "Specular", "Roughness", "f0", "Final"]
    diffuse, final = found["Diffuse"], found["Final"]
    assert diffuse.rendered is not None
    assert diffuse.truth is not None
    assert abs(int(diffuse.rendered[0, 0, 0]) - int(diffuse.truth[0, 0, 0])) <= 1  # sRGB of 0.214 is one half
    assert final.rendered is not None
    assert (final.rendered == final.truth).all()
    normal, specular = found["Normal"], found["Specular"]
    assert normal.truth is not None
    assert (normal.rendered == normal.truth).all()
    assert specular.truth is not None
    assert (specular.truth[0, 0, 0], specular.truth[0, 47, 0]) == (255, 0)
    assert found["Roughness"].truth is None


def test_a_turned_camera_does_not_turn_the_true_normals():
    turned = Camera(torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), torch.zeros(3), 40.0, 40.0, 24.0, 16.0, 48, 32)
    photo = torch.rand(3, *SIZE)
    straight = layer_pixels(layers(), photo, photo, camera(), truth())[2]
    assert (layer_pixels(layers(), photo, photo, turned, truth())[2].truth == straight.truth).all()


def test_light_through_glass_is_shown_where_there_is_some():
    photo = torch.rand(3, *SIZE)
    titles = [item.title for item in layer_pixels(layers(), photo, photo, camera(), truth(1.0))]
    assert titles[2] == "Transmission"


def test_without_layers_there_are_none_and_without_truth_one_row():
    photo = torch.rand(3, *SIZE)
    assert layer_pixels({}, photo, photo, camera(), truth()) == []
    found = layer_pixels(layers(), photo, photo, camera(), None)
    assert all(item.truth is None for item in found[:-1])


def test_parts_of_the_light_through_glass_are_shown_where_a_method_renders_them():
    photo = torch.rand(3, *SIZE)
    whole = truth(1.0)
    parts = replace(whole, inner=whole.transmitted / 4, contents=whole.transmitted / 4, behind=whole.transmitted / 2)
    rendered = layers() | {"inner": torch.full((3, *SIZE), 0.5), "behind": torch.full((3, *SIZE), 0.25)}
    found = {item.title: item for item in layer_pixels(rendered, photo, photo, camera(), parts)}
    assert list(found)[:5] == ["Diffuse", "Reflection", "Transmission", "Inner", "Behind"]
    inner = found["Inner"]
    assert inner.rendered is not None
    assert inner.truth is not None
    assert int(inner.rendered[0, 0, 0]) == 128
    assert 60 < int(inner.truth[0, 0, 0]) < 70  # sRGB of 0.2140 / 4
    unknown = {item.title: item for item in layer_pixels(rendered, photo, photo, camera(), whole)}
    assert unknown["Inner"].truth is None
    silent = [item.title for item in layer_pixels(layers(), photo, photo, camera(), parts)]
    assert silent == [item.title for item in layer_pixels(layers(), photo, photo, camera(), whole)]


def test_captions_are_in_the_symbols_of_the_method_that_made_the_layers():
    photo = torch.rand(3, *SIZE)

    def captions(method: str) -> dict[str, str]:
        symbols = find_method(method).layers
        return {each.title: each.caption for each in layer_pixels(layers(), photo, photo, camera(), truth(1), symbols)}

    traced, blended, metal, scoped = (captions(name) for name in ("rtgs", "3dgs_dr", "ref_gaussian", "ref_gs"))
    assert traced["Diffuse"] == "what the base set adds to the image: (1 − k_s) C_d; truth: diffuse light, sRGB encoded"
    assert "k_s w_t C_t" in traced["Transmission"]
    assert blended["Reflection"].startswith("what mirrored light adds: m C_r; truth")
    assert "metalness" in metal["Specular"]
    assert "inside of the scope" in scoped["Specular"]
    assert (
        captions("gaussian_shader")["Specular"]
        == "0 black, 1 white: tint, mean of its colours; truth: specular objects"
    )
    plain = {each.title: each.caption for each in layer_pixels(layers(), photo, photo, camera(), None)}
    assert not any(symbol in text for text in plain.values() for symbol in ("k_s", "w_r", "C_d"))
    for other in (blended, metal, scoped):
        assert not any("k_s" in text for text in other.values()), "the symbols of methods that trace"


def test_every_method_with_a_reflection_says_what_its_layers_are():
    for spec in own_methods():
        if spec.has & {MIRROR, FAR_LIGHT}:
            assert {"diffuse", "reflection", "specular"} <= spec.layers.keys(), spec.name
        assert spec.layers.keys() <= set(NAMES), spec.name
