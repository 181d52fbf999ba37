import pytest

from rtgs.scenes.synthetic.description import list_scenes, named_scene, read_description


def write(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


def test_shipped_scenes_read_and_have_a_transparent_shape():
    assert "glass_demo" in list_scenes()
    described = named_scene("glass_demo")
    assert [s.name for s in described.transparent] == ["jar"]
    assert described.viewpoints.count == 48


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"no synthetic scene 'nope'; there are .*glass_demo"):
        named_scene("nope")


def test_misspelt_key_names_file_shape_and_key(tmp_path):
    path = write(tmp_path, 'title = "x"\n[[shape]]\nname = "a"\nkind = "sphere"\nsizee = [1.0, 1.0, 1.0]\n')
    with pytest.raises(ValueError, match=r"scene.toml, shape 'a': unknown key 'sizee'"):
        read_description(path)


def test_unknown_kind_and_material_are_refused(tmp_path):
    path = write(tmp_path, 'title = "x"\n[[shape]]\nname = "a"\nkind = "cone"\n')
    with pytest.raises(ValueError, match="'cone' is not one of lathe"):
        read_description(path)
    path = write(tmp_path, 'title = "x"\n[[shape]]\nname = "a"\nkind = "box"\nmaterial = { kind = "velvet" }\n')
    with pytest.raises(ValueError, match=r"material.kind: 'velvet'"):
        read_description(path)


def test_scene_without_shapes_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no \[\[shape\]\]"):
        read_description(write(tmp_path, 'title = "empty"\n'))
