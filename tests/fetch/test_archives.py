"""``rtgs get`` against a server on this machine: archives, first and later ones, and what is wrong in them."""

from __future__ import annotations

import hashlib
import json
import stat
import zipfile

import pytest

from rtgs.core.errors import RtgsError
from rtgs.fetch.catalogue import Capture
from rtgs.fetch.get import SOURCE, get_capture
from rtgs.fetch.unpack import Limits, unpack
from tests.fetch.site_cases import PHOTO, archive_of, names, zipped


def test_an_archive_of_unknown_digest_is_recorded_at_first_and_compared_later(site, tmp_path):
    site.files["set.zip"] = zipped(("ref/sedan/images/a.jpg", PHOTO), ("ref/toycar/b.jpg", b"b"))
    told: list[str] = []
    folder = get_capture(archive_of(site), tmp_path, told.append, plain=True)
    assert (folder / "sedan" / "images" / "a.jpg").read_bytes() == PHOTO  # the one folder around all is left out
    digest = hashlib.sha256(site.files["set.zip"]).hexdigest()
    assert any(f"recorded is SHA-256 {digest}" in line for line in told)
    assert not json.loads((folder / SOURCE).read_text())["known"]
    get_capture(archive_of(site), tmp_path, told.append, plain=True)
    assert told[-1] == "set: it is all there"
    folder.rename(tmp_path / "elsewhere")
    site.files["set.zip"] = zipped(("ref/sedan/images/a.jpg", PHOTO[::-1]))
    with pytest.raises(RtgsError, match=f"has changed: its SHA-256 was {digest} when first"):
        get_capture(archive_of(site), tmp_path, told.append, plain=True)
    assert not folder.exists()
    folder.mkdir()
    with pytest.raises(RtgsError, match="is there and was not brought by this command"):
        get_capture(archive_of(site), tmp_path, told.append, plain=True)


@pytest.mark.parametrize("listed", [False, True])
def test_a_bad_first_archive_does_not_bar_a_good_one(site, tmp_path, listed):
    site.files["set.zip"] = b"<html>come again later</html>"
    bad = (
        archive_of(site)
        if not listed
        else Capture("set", "", "", "page", archive=site.file("set.zip", most=10_000_000))
    )
    with pytest.raises(RtgsError, match="is no whole zip archive"):
        get_capture(bad, tmp_path, print, plain=True)
    assert names(tmp_path) == [".set.lock"]
    site.files["set.zip"] = zipped(("a.jpg", PHOTO))
    good = (
        archive_of(site)
        if not listed
        else Capture("set", "", "", "page", archive=site.file("set.zip", most=10_000_000))
    )
    (folder := get_capture(good, tmp_path, print, plain=True)).joinpath("a.jpg").stat()
    assert json.loads((folder / SOURCE).read_text())["known"] is listed
    assert (tmp_path / ".set.first.json").is_file() is not listed


def test_an_archive_that_a_killed_call_left_is_used_only_if_it_is_the_listed_one(site, tmp_path):
    site.files["set.zip"] = zipped(("a.jpg", PHOTO))
    capture = Capture("set", "", "", "page", archive=site.file("set.zip", most=10_000_000))
    for left, asked in ((zipped(("other.jpg", PHOTO)), 1), (site.files["set.zip"], 0)):
        site.asked.clear()
        (tmp_path / ".set.zip").write_bytes(left)
        folder = get_capture(capture, tmp_path, print, plain=True)
        assert (names(folder), len(site.asked)) == ([SOURCE, "a.jpg"], asked)
        folder.rename(tmp_path / f"brought {asked}")


def link(name: str) -> zipfile.ZipInfo:
    member = zipfile.ZipInfo(name)
    member.create_system, member.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    return member


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ([("../../evil", b"x")], r"leaves its folder \(\.\.\)"),
        ([("ok/a", b"x"), ("ok/../../evil", b"x")], r"leaves its folder"),
        ([("..\\evil", b"x")], r"leaves its folder"),
        ([("/tmp/evil", b"x")], "is absolute"),
        ([("C:/evil", b"x")], "is absolute"),
        ([(link("door"), b"/etc")], "is a link or a device"),
        ([("a/B.jpg", b"x"), ("a/b.jpg", b"x")], "two members are called"),
        ([("a", b"x"), ("a/b", b"x")], r"'a' is a file, and the folder of 'a/b'"),
        ([("a/b/c/d", b"x"), ("A/B", b"x")], r"'A/B' is a file, and the folder of 'a/b/c/d'"),
        ([("zeros", bytes(300_000_000))], "holds more than an archive may"),
    ],
    ids=["up", "up inside", "up by backslash", "absolute", "drive", "link", "twice", "above", "below", "bomb"],
)
def test_members_that_misbehave_leave_nothing(tmp_path, members, message):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "bad.zip").write_bytes(zipped(*members))
    (tmp_path / "out").mkdir()
    with pytest.raises(RtgsError, match=message):
        unpack(tmp_path / "in" / "bad.zip", tmp_path / "out" / "set")
    assert names(tmp_path / "out") == []
    assert names(tmp_path) == ["bad.zip", "in", "out"]


def test_an_archive_whose_header_lies_is_stopped_as_it_is_unpacked(tmp_path):
    content = bytearray(zipped(("zeros", bytes(60_000_000))))
    at = content.rfind(b"PK\x01\x02")
    content[at + 24 : at + 28] = (1000).to_bytes(4, "little")  # the size that the directory promises
    (tmp_path / "bad.zip").write_bytes(content)
    with pytest.raises(RtgsError):
        unpack(tmp_path / "bad.zip", tmp_path / "set", Limits(bytes=100_000))
    assert names(tmp_path) == ["bad.zip"]


def test_members_count_together_as_they_are_unpacked(tmp_path):
    content = bytearray(zipped(("one", bytes(700_000)), ("two", bytes(700_000))))
    at = content.find(b"PK\x01\x02")
    while at >= 0:  # the directory promises little of each
        content[at + 24 : at + 28] = (1000).to_bytes(4, "little")
        at = content.find(b"PK\x01\x02", at + 4)
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(RtgsError):
        unpack(tmp_path / "a.zip", tmp_path / "set", Limits(bytes=1_000_000))
    assert names(tmp_path) == ["a.zip"]


def test_a_cut_archive_is_refused(tmp_path):
    (tmp_path / "bad.zip").write_bytes(zipped(("a", PHOTO))[:-40])
    with pytest.raises(RtgsError, match="is no whole zip archive"):
        unpack(tmp_path / "bad.zip", tmp_path / "set")
    assert names(tmp_path) == ["bad.zip"]


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_damaged_member_is_refused(tmp_path, method):
    content = bytearray(zipped(("a", PHOTO), method=method))
    for at in (36, 44):  # inside LZMA's own header, and inside the packed bytes
        content[at : at + 8] = b"\xff" * 8
        (tmp_path / "bad.zip").write_bytes(content)
        with pytest.raises(RtgsError, match="is no whole zip archive"):
            unpack(tmp_path / "bad.zip", tmp_path / "set")
        assert names(tmp_path) == ["bad.zip"]


def test_a_member_before_the_archives_beginning_is_refused(tmp_path):
    content = bytearray(zipped(("a", PHOTO)))
    at = content.rfind(b"PK\x05\x06")
    content[at + 16 : at + 20] = (1 << 20).to_bytes(4, "little")  # where the directory is said to begin
    (tmp_path / "bad.zip").write_bytes(content)
    with pytest.raises(RtgsError, match="is no whole zip archive"):
        unpack(tmp_path / "bad.zip", tmp_path / "set")
    assert names(tmp_path) == ["bad.zip"]


@pytest.mark.parametrize("member", ["a.jpg", "all/a.jpg"])
def test_what_is_unpacked_has_the_rights_of_any_new_folder(tmp_path, member):
    (tmp_path / "set.zip").write_bytes(zipped((member, PHOTO), (f"{member}.txt", b"b")))
    unpack(tmp_path / "set.zip", tmp_path / "set")
    (tmp_path / "usual").mkdir()
    assert names(tmp_path / "set") == ["a.jpg", "a.jpg.txt"]
    assert (tmp_path / "set").stat().st_mode == (tmp_path / "usual").stat().st_mode
    assert names(tmp_path) == ["a.jpg", "a.jpg.txt", "set", "set.zip", "usual"]
