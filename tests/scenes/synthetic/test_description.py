import pytest

from rtgs.core.errors import RtgsError
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


BALL = 'title = "x"\n[[shape]]\nname = "a"\nkind = "sphere"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('title = "x', r"scene file .*scene\.toml is no TOML .Unterminated string"),
        ('title = "x"\n[[shape]]\nname = "a"\n', r"scene.toml, shape 'a': the key 'kind' is missing"),
        ('[[shape]]\nname = "a"\nkind = "sphere"\n', r"scene.toml: the key 'title' is missing"),
        ('title = "x"\nshape = 3\n', r"shape = 3 is no list of tables, write \[\[shape\]\] above each"),
        (BALL + "material = 3\n", r"shape 'a', material: 3 is no table"),
        (
            BALL + 'size = ["a", 1.0, 1.0]\n',
            r"shape 'a': size = \['a', 1.0, 1.0\] does not fit, give a list of 3 numbers",
        ),
        (BALL + "size = [1.0]\n", r"shape 'a': size = \[1.0\] does not fit"),
        (BALL + "turn = true\n", r"shape 'a': turn = True does not fit, give a number"),
        (BALL + "turn = nan\n", r"shape 'a': turn = nan does not fit"),
        (BALL + "inward = 1\n", r"shape 'a': inward = 1 does not fit, give true or false"),
        (BALL + "emission = 3.0\n", r"shape 'a': emission = 3.0 does not fit, give a list of 3 numbers"),
        (BALL + "profile = [[1.0]]\n", r"give a list, each of it a list of 2 numbers"),
        (BALL + "size = [0.0, 1.0, 1.0]\n", r"shape 'a': size\[0\] = 0 must be more than 0"),
        (BALL + '[[shape]]\nname = "a"\nkind = "box"\n', r"more than one shape is called 'a'"),
        (BALL + "[viewpoints]\ncount = 0\n", r"scene.toml, viewpoints: count = 0 must be more than 0"),
        (BALL + "[viewpoints]\nfield_of_view = 180.0\n", r"field_of_view = 180 must be below 180"),
        (BALL + "[viewpoints]\nelevation = [10.0, 90.0]\n", r"elevation = 90 must be below 90"),
        (BALL + "[viewpoints]\nwide_every = 1\n", r"wide_every = 1 must be 0 .no wide lens. or 2 to 10000"),
        (BALL + "[viewpoints]\nwide_field_of_view = 180.0\n", r"wide_field_of_view = 180 must be below 180"),
        (BALL + "[viewpoints]\nwide_elevation = [-90.0, 9.0]\n", r"wide_elevation = 90 must be below 90"),
    ],
)
def test_what_does_not_describe_a_scene_is_refused_with_its_place(text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read_description(write(tmp_path, text))


def test_whole_numbers_are_numbers_and_bytes_are_no_text(tmp_path):
    assert read_description(write(tmp_path, BALL + "size = [2, 1, 1]\n")).shapes[0].size == (2, 1, 1)
    path = tmp_path / "bytes.toml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"bytes\.toml is no TOML"):
        read_description(path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("exposure = 0.0", "scene.toml: exposure = 0 must be more than 0"),
        ("exposure = -1", "exposure = -1 must be more than 0"),
        ("exposure = 1e300", r"exposure = 1e\+300 must be 0 to 1e\+06"),
        ("constant_light = [-1.0, 0.0, 0.0]", "constant_light = -1 must be"),
        ("exposure = " + "9" * 400, "exposure is a whole number of .* bits"),
        ('name = "other"', "unknown key 'name'"),
        ("viewpoints = { count = 1000000000 }", "count = 1e[+]09 must be 1 to 10000"),
        ("viewpoints = { jitter = 2.0 }", "jitter = 2 must be 0 to 1"),
        ("viewpoints = { radius = [1.0, 1e300] }", r"radius = 1e\+300"),
    ],
)
def test_values_that_make_no_picture_are_refused(line, message, tmp_path):
    with pytest.raises(RtgsError, match=message):
        read_description(write(tmp_path, f"{line}\n{BALL}"))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("count = 1000000000", "count = 1e[+]09 must be 1 to 100000"),
        ("relief = -1.0", "relief = -1 must be"),
        ("position = [1e300, 0.0, 0.0]", "position = 1e[+]300 must be"),
        ("material = { ior = 0.0 }", "ior = 0 must be 1 to 10"),
        ("material = { roughness = 2.0 }", "roughness = 2 must be 0 to 1"),
        ("material = { color = [-1.0, 0.0, 0.0] }", "color = -1 must be 0 to 1"),
    ],
)
def test_shapes_that_cannot_be_are_refused(line, message, tmp_path):
    with pytest.raises(RtgsError, match=f"shape 'a'.*{message}"):
        read_description(write(tmp_path, f"{BALL}{line}\n"))
