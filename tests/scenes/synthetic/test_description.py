import pytest

from rtgs.scenes.synthetic.description import SPECULAR, list_scenes, named_scene, read_description


def write(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


def test_a_scene_by_its_name():
    described = named_scene("ball_statue")
    assert [s.name for s in described.transparent] == ["ball"]
    assert described.viewpoints.count == 48


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"no synthetic scene 'nope'; there are ball_statue, .*toycar"):
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


STAND_INS = {"ball_statue", "popcorn_cup", "real_bottle", "tall_bottle", "sedan", "spheres", "toycar"}


def test_the_nine_scenes_read_and_say_what_they_stand_in_for():
    assert set(list_scenes()) == STAND_INS | {"thick_ball", "matte_room"}
    for name in list_scenes():
        described = named_scene(name)
        assert described.viewpoints.count == 48
        assert bool(described.stand_in_for) == (name in STAND_INS)


def test_only_what_should_shine_shines():
    def kinds(name):
        return {shape.material.kind for shape in named_scene(name).shapes} & set(SPECULAR)

    for name in ("ball_statue", "popcorn_cup", "real_bottle", "tall_bottle"):
        assert kinds(name) == {"thin_glass"}, "thin walls, as the method assumes"
    for name in ("sedan", "spheres", "toycar"):
        assert kinds(name) == {"glossy", "mirror"}
    assert kinds("thick_ball") == {"glass"}
    assert kinds("matte_room") == set()


def test_parts_are_checked(tmp_path):
    shape = 'title = "x"\n[[shape]]\nname = "a"\nkind = "sculpt"\n'
    with pytest.raises(ValueError, match=r"a sculpt needs at least one \[\[shape.part\]\]"):
        read_description(write(tmp_path, shape))
    with pytest.raises(ValueError, match=r"part\.form: 'cube' is not one of ellipsoid"):
        read_description(write(tmp_path, shape + '[[shape.part]]\nform = "cube"\n'))
    with pytest.raises(ValueError, match="part: unknown key 'sise'"):
        read_description(write(tmp_path, shape + "[[shape.part]]\nsise = [1, 1, 1]\n"))
