"""Damaged binary models: found by their counts, before a library takes memory for them."""

from __future__ import annotations

import resource
import struct

import pytest

from rtgs.scenes.capture import CaptureError
from rtgs.scenes.importers.colmap_files import check_files
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings

from .captures import ColmapCapture

MANY = (2**64 - 1, 2**40, 1_000_000, 11)
RADIAL = (60.0, 33.0, 23.0, 0.01)


@pytest.fixture(autouse=True)
def limits():
    """A defect ends the test by running out of time, not the machine."""
    before = resource.getrlimit(resource.RLIMIT_CPU)
    used = int(sum(resource.getrusage(resource.RUSAGE_SELF)[:2]))
    resource.setrlimit(resource.RLIMIT_CPU, (used + 120, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_CPU, before)


def forge(root, file: str, place: int, form: str, value: float):
    path = root / "sparse/0" / file
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, place, value)
    path.write_bytes(data)
    return root


def refused(root, *parts: str) -> None:
    with pytest.raises(CaptureError) as error:
        load_scene(SceneSettings(path=str(root)))
    for part in ("sparse/0 cannot be read", "export the model again", *parts):
        assert part in str(error.value)


@pytest.mark.parametrize("count", MANY)
@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_forged_counts_of_records(tmp_path, file, count):
    refused(forge(ColmapCapture(tmp_path).write(), file, 0, "<Q", count), f"{file}: ")


@pytest.mark.parametrize("count", MANY)
@pytest.mark.parametrize(
    ("file", "place", "form"),
    [
        ("images.bin", 8 + 64 + 13, "<Q"),  # observations of the first image, after its name
        ("points3D.bin", 8 + 43, "<Q"),  # its track
        ("rigs.bin", 8 + 4, "<I"),  # its sensors
        ("frames.bin", 8 + 64, "<I"),  # its data
    ],
)
def test_forged_counts_of_parts(tmp_path, file, place, form, count):
    root = forge(ColmapCapture(tmp_path).write(), file, place, form, count % 2**32 if form == "<I" else count)
    refused(root, f"{file}: ")


@pytest.mark.parametrize("side", [0, 65_536, 4_000_000_000, 2**63])
@pytest.mark.parametrize("place", [16, 24])
@pytest.mark.parametrize(("model", "params"), [("PINHOLE", (60.0, 58.0, 33.0, 23.0)), ("SIMPLE_RADIAL", RADIAL)])
def test_cameras_of_absurd_size(tmp_path, model, params, place, side):
    root = ColmapCapture(tmp_path, model=model, params=params).write()
    refused(forge(root, "cameras.bin", place, "<Q", side), "cameras.bin: camera 1 takes pictures of", f"{side}")


@pytest.mark.parametrize("side", [0, 4_000_000_000])
def test_text_cameras_of_absurd_size(tmp_path, side):
    root = ColmapCapture(tmp_path, model="SIMPLE_RADIAL", params=RADIAL, text=True).write()
    path = root / "sparse/0/cameras.txt"
    path.write_text(path.read_text().replace(" 64 48 ", f" {side} 48 "))
    with pytest.raises(CaptureError, match=f"sparse/0.*image size {side}x48"):
        load_scene(SceneSettings(path=str(root)))


def test_unknown_camera_model_and_reference(tmp_path):
    refused(forge(ColmapCapture(tmp_path / "a").write(), "cameras.bin", 12, "<i", 99), "unknown model 99")
    refused(forge(ColmapCapture(tmp_path / "b").write(), "images.bin", 8 + 60, "<I", 7), "camera 7, which cameras.bin")
    refused(forge(ColmapCapture(tmp_path / "c").write(), "frames.bin", 8 + 4, "<I", 7), "rig 7, which rigs.bin")


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_every_truncation_and_every_addition_is_found(tmp_path, file):
    root = ColmapCapture(tmp_path, views=2, points=3).write()
    path = root / "sparse/0" / file
    whole = path.read_bytes()
    check_files(root / "sparse/0")
    for length in [*range(1, len(whole)), len(whole) + 1]:
        path.write_bytes((whole + b"\0")[:length])
        with pytest.raises(ValueError, match=file):
            check_files(root / "sparse/0")


@pytest.mark.parametrize("focal", [1e-300, 1e300, 1e-5, 1e7])
@pytest.mark.parametrize(("model", "params"), [("PINHOLE", (60.0, 58.0, 33.0, 23.0)), ("SIMPLE_RADIAL", RADIAL)])
def test_absurd_focal_lengths(tmp_path, model, params, focal):
    root = ColmapCapture(tmp_path, model=model, params=(focal, *params[1:])).write()
    with pytest.raises(CaptureError, match=r"focal length .* is not plausible for 64x48 pixels"):
        load_scene(SceneSettings(path=str(root)))


def test_absurd_principal_point(tmp_path):
    root = ColmapCapture(tmp_path, params=(60.0, 58.0, 1e200, 23.0)).write()
    with pytest.raises(CaptureError, match=r"principal point .* lies far from the 64x48 photo"):
        load_scene(SceneSettings(path=str(root)))
