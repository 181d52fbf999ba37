"""Side files of captures that are not what they seem: refused in words, before memory is taken for them."""

from __future__ import annotations

import io
import resource
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from rtgs.prepare.poses.photos import lay_out, read_photo_set
from rtgs.scenes.capture import CaptureError
from rtgs.scenes.check import check_capture
from rtgs.scenes.exif import PhotoExif, read_exif
from rtgs.scenes.images import read_normals, read_photo, turned_upright
from rtgs.scenes.importers.transforms import read_point_file
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings

from .captures import HEIGHT, WIDTH, ColmapCapture, edit_transforms, pinhole_picture, write_transforms


def refused(root, message: str) -> None:
    settings = SceneSettings(path=str(root))
    with pytest.raises(CaptureError, match=message):
        load_scene(settings)
    assert any(finding.severity == "error" for finding in check_capture(settings)), "the check calls it ready"


def npy(header: str, body: bytes = b"", version: int = 1) -> bytes:
    text = header.encode()
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H", len(text)) + text + body


def shape(text: str, kind: str = "<f4") -> str:
    return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {text}, }}\n"


def archive() -> bytes:
    stream = io.BytesIO()
    np.savez(stream, a=np.zeros((4, 4, 3)))
    return stream.getvalue()


BAD_NPY = {
    "archive": (archive(), "npz archive"),
    "empty": (npy(shape("(0, 0, 3)")), "at least one pixel"),
    "forged": (npy(shape("(1000000, 1000000, 3)")), "announces 12000000000000 bytes"),
    "overflowing": (npy(shape("(4294967296, 4294967296, 3)")), "announces"),
    "negative": (npy(shape("(-1, 4, 3)")), "save an array of numbers"),
    "short": (npy(shape("(48, 64, 3)"), bytes(100)), "announces 36864 bytes of numbers, 100 are there"),
    "long": (npy(shape("(1, 1, 3)"), bytes(100)), "announces 12 bytes of numbers, 100 are there"),
    "object": (npy(shape("(4,)", "|O"), bytes(100)), "save an array of numbers"),
    "truncated": (npy(shape("(48, 64, 3)"))[:30], "header is damaged"),
    "nothing": (b"", "does not begin as a .npy file"),
    "nested": (npy("(" * 5000), "header is damaged"),
    "code": (npy("__import__('os').abort()"), "header is damaged"),
}


@pytest.mark.parametrize("name", BAD_NPY)
def test_damaged_normal_maps(tmp_path, name):
    content, message = BAD_NPY[name]
    root = ColmapCapture(tmp_path, views=3).write()
    (root / "normals").mkdir()
    (root / "normals/photo_01.npy").write_bytes(content)
    refused(root, f"normal map .*photo_01.npy .*{message}")


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("kind", ["<f4", ">f8", "<f2"])
def test_sound_normal_maps_are_read_as_numpy_reads_them(tmp_path, order, kind):
    values = np.asarray(np.random.default_rng(0).normal(size=(5, 6, 3)), dtype=kind, order=order)
    np.save(tmp_path / "a.npy", values)
    expected = values.astype(np.float32)
    length = np.linalg.norm(expected, axis=-1, keepdims=True)
    np.testing.assert_array_equal(
        read_normals(tmp_path / "a.npy"), np.where(length > 0.5, expected / np.maximum(length, 1e-6), 0)
    )


def huge_png(side: int) -> bytes:
    """One grey, black, compressed to nothing."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = zlib.compress(bytes((side * 3 + 1) * 2))  # two rows are enough: nobody may read them
    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("side", "message"), [(12_000, "8 times larger"), (13_000, "at most 150,000,000 are read")])
@pytest.mark.parametrize("place", ["images/photo_01.png", "masks/photo_01.png", "normals/photo_01.png"])
def test_pictures_of_too_many_pixels_are_refused_before_they_are_decoded(tmp_path, place, side, message):
    root = ColmapCapture(tmp_path, views=3, size=(64, 64), params=(60.0, 60.0, 32.0, 32.0)).write()
    (root / place).parent.mkdir(exist_ok=True)
    (root / place).write_bytes(huge_png(side))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(root, message)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000, "kilobytes"


def test_pictures_of_other_formats_are_not_opened(tmp_path):
    root = ColmapCapture(tmp_path, views=3).write()
    (root / "images/photo_01.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\nshowpage\n")
    refused(root, "photo_01.png cannot be read")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"w": 0}, "image size 0.0x48.0"),
        ({"w": float("inf")}, "image size infx48.0"),
        ({"w": float("nan")}, "image size nanx48.0"),
        ({"w": 4e9}, "image size 4000000000.0x48.0"),
        ({"w": int("9" * 400)}, "whole numbers go up to"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 0}, "camera_angle_x=0 must be an angle of view"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 1e-320}, "hold NaN or inf"),
        ({"fl_x": None, "fl_y": None, "camera_angle_y": 4}, "camera_angle_y=4 must be an angle of view"),
        ({"fl_x": 1e-300}, "focal length 1e-300 is not plausible"),
        ({"fl_x": 1e300}, r"focal length 1e\+300 is not plausible"),
    ],
)
def test_absurd_cameras_of_transforms(tmp_path, keys, message):
    root = write_transforms(tmp_path)
    edit_transforms(root, lambda content: content.update(keys))
    edit_transforms(root, lambda content: [content.pop(key) for key in keys if keys[key] is None])
    refused(root, message)


def test_an_infinite_size_as_json_writes_it(tmp_path):
    root = write_transforms(tmp_path)
    path = root / "transforms.json"
    path.write_text(path.read_text().replace('"w": 64', '"w": 1e999'))
    refused(root, "image size inf")


def points(header: str, body: bytes) -> bytes:
    return f"ply\nformat binary_little_endian 1.0\n{header}end_header\n".encode() + body


XYZ = "property float x\nproperty float y\nproperty float z\n"
BAD_PLY = {
    "forged": (points(f"element vertex 1000000000000\n{XYZ}", bytes(120)), "announces 1000000000000 vertex"),
    "rows of nothing": (points("element vertex 1000000000\n", b""), "rows of nothing"),
    "misaligned": (points(f"element vertex 10\n{XYZ}", bytes(127)), "7 bytes follow the 10 rows"),
    "long line": (b"ply\ncomment " + b"x" * 2**20, "longer than 4096 bytes"),
    "long header": (b"ply\n" + b"comment\n" * 10_000, "more than 4096 lines"),
    "no end": (b"ply\nformat ascii 1.0\n", "has no end"),
    "absurd": (points(f"element vertex 10\n{XYZ}", np.full(30, 5e22, "<f4").tobytes()), "half of its points"),
    "lists": (points("element vertex 10\nproperty list uchar float x\n", bytes(10)), "no PLY file with x y z"),
    "type": (points("element vertex 10\nproperty quad x\n", bytes(10)), "no property of PLY"),
}


@pytest.mark.parametrize("name", BAD_PLY)
def test_damaged_point_files(tmp_path, name):
    content, message = BAD_PLY[name]
    (tmp_path / "p.ply").write_bytes(content)
    with pytest.raises(CaptureError, match=f"p.ply.*{message}"):
        read_point_file(tmp_path / "p.ply")


def jpeg_with(tag: int, kind: int, value: bytes) -> bytes:
    """A photo whose EXIF holds one entry of one value, right or wrong."""
    entry = struct.pack("<HHI", tag, kind, 1) + value[:4].ljust(4, b"\0")
    tables = b"II*\0\x08\0\0\0" + struct.pack("<H", 1) + entry + bytes(4)
    stream = io.BytesIO()
    picture = Image.fromarray((pinhole_picture() * 255).astype(np.uint8))
    picture.save(stream, "JPEG", exif=b"Exif\0\0" + tables)
    return stream.getvalue()


@pytest.mark.parametrize("kind", [1, 2, 3, 4, 5, 7, 9, 10, 11, 12, 13, 99])
@pytest.mark.parametrize("tag", [0x0112, 0x010F, 0x0110, 0x8769, 0x920A, 0xA405])
def test_exif_of_wrong_types_says_nothing(tmp_path, tag, kind):
    (tmp_path / "a.jpg").write_bytes(jpeg_with(tag, kind, b"\xff\xff\xff\xff"))
    assert read_photo(tmp_path / "a.jpg", expected=(WIDTH, HEIGHT)).shape == (HEIGHT, WIDTH, 3)
    photos = read_photo_set(tmp_path)
    assert (photos.photos[0].width, photos.photos[0].height) == (WIDTH, HEIGHT)
    assert not photos.photos[0].turned
    lay_out(photos, tmp_path / "out", (0.0, 0.0, 0.0), lambda number: None)
    assert (tmp_path / "out/a.jpg").is_file()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_pillow_turns_them(tmp_path, orientation):
    from PIL import ImageOps

    picture = Image.fromarray((pinhole_picture() * 255).astype(np.uint8))
    exif = Image.Exif()
    exif[0x0112] = orientation
    picture.save(tmp_path / "a.png", exif=exif)
    with Image.open(tmp_path / "a.png") as stored:
        assert read_exif(stored) == PhotoExif(orientation)
        expected = np.asarray(ImageOps.exif_transpose(stored))
        np.testing.assert_array_equal(np.asarray(turned_upright(stored, orientation)), expected)


@pytest.mark.parametrize("value", [5, "photo_01.png", {"a": 1}, True])
def test_splits_of_transforms_that_are_no_lists(tmp_path, value):
    root = write_transforms(tmp_path, train_filenames=value, test_filenames=["images/photo_01.png"])
    refused(root, "train_filenames is .*, not a list of names")
