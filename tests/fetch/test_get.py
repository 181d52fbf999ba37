"""``rtgs get`` against a server on this machine: resuming, other files than the listed ones."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import socket
from pathlib import Path

import pytest

from pipelines.cli.main import main
from rtgs.core.errors import RtgsError
from rtgs.fetch import catalogue
from rtgs.fetch.catalogue import Capture, RemoteFile, capture_names, find_capture, read_capture
from rtgs.fetch.get import SOURCE, get_capture
from rtgs.fetch.http import NotReached, download, refuse_address
from tests.fetch.site_cases import DIGEST, PHOTO, names


def bring(file: RemoteFile, path: Path) -> str:
    return download(file, path, plain=True, pause=0.0)


def test_a_file_that_breaks_off_goes_on_where_it_was(site, tmp_path):
    site.cut = [300_000, 500_000]
    assert bring(site.file("a.jpg"), tmp_path / "a.jpg") == DIGEST
    assert (tmp_path / "a.jpg").read_bytes() == PHOTO
    assert [wanted for _, wanted in site.asked] == [None, "bytes=300000-", "bytes=800000-"]
    assert names(tmp_path) == ["a.jpg"]


def test_a_call_after_one_that_gave_up_goes_on(site, tmp_path):
    site.cut = [1000] * 4
    with pytest.raises(NotReached, match="ended after 4,000 of 1,024,000 bytes"):
        bring(site.file("a.jpg"), tmp_path / "a.jpg")
    assert not (tmp_path / "a.jpg").exists()
    bring(site.file("a.jpg"), tmp_path / "a.jpg")
    assert site.asked[-1] == ("a.jpg", "bytes=4000-")
    assert (tmp_path / "a.jpg").read_bytes() == PHOTO


def test_a_server_without_ranges_begins_again(site, tmp_path):
    site.ranges, site.cut = False, [1000]
    assert bring(site.file("a.jpg"), tmp_path / "a.jpg") == DIGEST
    assert (tmp_path / "a.jpg").stat().st_size == len(PHOTO)


def test_a_file_of_unknown_digest_goes_on_only_while_it_is_the_same(site, tmp_path):
    file = site.file("a.jpg", size=None, sha256=None, most=10_000_000)
    site.etags["a.jpg"], site.cut = '"one"', [1000] * 4
    with pytest.raises(NotReached):
        bring(file, tmp_path / "a.jpg")
    site.files["a.jpg"], site.etags["a.jpg"] = PHOTO[::-1], '"two"'
    assert bring(file, tmp_path / "a.jpg") == hashlib.sha256(PHOTO[::-1]).hexdigest()
    site.etags["a.jpg"], site.cut = "", [1000]  # without a validator nothing is gone on with
    bring(file, tmp_path / "again.jpg")
    assert site.asked[-1] == ("a.jpg", None)


def test_another_file_of_the_same_size_is_refused(site, tmp_path):
    with pytest.raises(RtgsError, match=f"its SHA-256 is {DIGEST} and not 0{{64}}.*nothing of it is kept"):
        bring(site.file("a.jpg", sha256="0" * 64), tmp_path / "a.jpg")
    assert names(tmp_path) == []


@pytest.mark.parametrize("lengths", [True, False])
def test_a_file_that_is_too_large_is_not_read_to_its_end(site, tmp_path, lengths):
    site.lengths = lengths
    with pytest.raises(RtgsError, match=r"expected; nothing of it is kept"):
        bring(site.file("a.jpg", size=1000, most=1000), tmp_path / "a.jpg")
    with pytest.raises(RtgsError, match=r"at most 1,000 were expected"):
        bring(site.file("a.jpg", size=None, sha256=None, most=1000), tmp_path / "a.jpg")
    assert names(tmp_path) == []


def test_redirects_lead_to_no_file_of_this_machine(site, tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(PHOTO)
    for target in (secret.as_uri(), "ftp://127.0.0.1/a.jpg", "data:,hello"):
        site.redirects["moved.jpg"] = target
        with pytest.raises((RtgsError, NotReached), match=r"not by|302"):
            bring(site.file("moved.jpg", size=len(PHOTO), sha256=DIGEST, most=len(PHOTO)), tmp_path / "out.jpg")
    assert not (tmp_path / "out.jpg").exists()
    site.redirects["moved.jpg"] = f"{site.address}/a.jpg"
    file = site.file("moved.jpg", size=len(PHOTO), sha256=DIGEST, most=len(PHOTO))
    assert bring(file, tmp_path / "out.jpg") == DIGEST


def test_addresses_are_https(site, tmp_path):
    for url in ("http://example.org/a", "file:///etc/passwd", "ftp://example.org/a", "/etc/passwd"):
        with pytest.raises(RtgsError, match="captures come by HTTPS"):
            refuse_address(url)
    with pytest.raises(RtgsError, match="captures come by HTTPS"):
        download(site.file("a.jpg"), tmp_path / "a.jpg")
    assert site.asked == []


def test_a_missing_file_is_told_at_once(site, tmp_path):
    with pytest.raises(RtgsError, match="the server says 404"):
        bring(RemoteFile("b", f"{site.address}/b", 1, None, 1), tmp_path / "b")
    assert len(site.asked) == 1


def test_offline_is_said_with_what_to_do(site, tmp_path):
    with socket.socket() as deaf:  # bound, but nobody listens
        deaf.bind(("127.0.0.1", 0))
        _refused(RemoteFile("a.jpg", f"http://127.0.0.1:{deaf.getsockname()[1]}/a.jpg", 1, None, 1), tmp_path)


def _refused(nobody: RemoteFile, tmp_path: Path) -> None:
    capture = Capture("far", "far away", "none", "https://example.org/far", (nobody,))
    with pytest.raises(NotReached, match=r"Is this machine offline.*the same command goes on.*example\.org/far"):
        get_capture(capture, tmp_path, print, plain=True, pause=0.0)


def test_a_full_disk_is_told_before_anything_is_brought(site, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage._replace(free=len(PHOTO)))
    capture = Capture("full", "", "none", "page", (site.file("a.jpg"),))
    with pytest.raises(RtgsError, match=r"has 1 MB free, .* are needed: name a to="):
        get_capture(capture, tmp_path, print, plain=True, pause=0.0)
    assert site.asked == []


# ---- captures


def test_a_capture_of_files_brings_what_is_missing_and_keeps_what_is_there(site, tmp_path):
    site.files["images/b.jpg"] = b"second"
    capture = Capture("two", "", "free", "page", tuple(site.file(name) for name in site.files))
    folder = get_capture(capture, tmp_path, print, plain=True)
    assert (folder / "images" / "b.jpg").read_bytes() == b"second"
    source = json.loads((folder / SOURCE).read_text())
    assert (source["licence"], source["known"], source["digests"]["a.jpg"]) == ("free", True, DIGEST)
    (folder / "a.jpg").unlink()
    site.asked.clear()
    get_capture(capture, tmp_path, print, plain=True)
    assert [path for path, _ in site.asked] == ["a.jpg"]
    (folder / "a.jpg").write_bytes(b"my own")
    with pytest.raises(RtgsError, match=r"a\.jpg is there and is not the file of"):
        get_capture(capture, tmp_path, print, plain=True)
    assert (folder / "a.jpg").read_bytes() == b"my own"


def test_a_capture_of_files_is_not_mixed_with_other_files(site, tmp_path):
    site.files["images/b.jpg"] = b"second"
    capture = Capture("two", "", "free", "page", tuple(site.file(name) for name in site.files))
    mine = tmp_path / "two" / "images" / "mine.jpg"
    mine.parent.mkdir(parents=True)
    mine.write_bytes(b"my own")
    with pytest.raises(RtgsError, match=r"two was not brought by this command: images/mine\.jpg is no file of two"):
        get_capture(capture, tmp_path, print, plain=True)
    assert site.asked == []
    assert names(tmp_path / "two") == ["images", "mine.jpg"]
    mine.unlink()
    site.cut = [1000] * 4
    with pytest.raises(NotReached):  # a part is left, and is no file of somebody else
        get_capture(capture, tmp_path, print, plain=True, pause=0.0)
    assert "a.jpg.part" in names(tmp_path / "two")
    folder = get_capture(capture, tmp_path, print, plain=True)
    mine.write_bytes(b"made of it later")  # whole and named: what comes to it is its owner's business
    assert get_capture(capture, tmp_path, print, plain=True) == folder
    (tmp_path / "far").write_bytes(b"")
    with pytest.raises(RtgsError, match="far is there and is no folder"):
        get_capture(dataclasses.replace(capture, name="far"), tmp_path, print, plain=True)


# ---- what is listed


@pytest.mark.parametrize("name", capture_names())
def test_what_is_listed_can_be_brought_or_says_how(name):
    capture = find_capture(name)
    assert capture.title
    assert capture.licence
    refuse_address(capture.page)
    assert bool(capture.files) + (capture.archive is not None) + bool(capture.by_hand) == 1
    for file in (*capture.files, *([capture.archive] if capture.archive else [])):
        refuse_address(file.url)
        assert file.most > 0
        assert file.sha256 is None or len(bytes.fromhex(file.sha256)) == 32
    assert len({file.name.casefold() for file in capture.files}) == len(capture.files)
    assert all(file.sha256 for file in capture.files)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"title": "a"}', "describes no capture: KeyError"),
        ('{"title": "a", "licence": "", "page": "", "base": "https://a/", "files": [["../b", 1, "00"]]}', "leaves"),
        ('{"title": "a", "licence": "", "page": "", "base": "https://a/", "files": [["b"]]}', "describes no capture"),
    ],
)
def test_a_damaged_description_is_named(tmp_path, text, message):
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(RtgsError, match=message):
        read_capture(tmp_path / "bad.json")


def test_the_command(site, tmp_path, monkeypatch, capsys):
    assert main(["get"]) == 0
    assert "wall_clock: a clock behind a flat glass door; 44 photos, 11 MB" in capsys.readouterr().out
    assert main(["get", "wall_clok"]) == 1
    assert "did you mean wall_clock?" in capsys.readouterr().err
    assert main(["get", "nu_nerf", f"to={tmp_path}"]) == 1
    told = capsys.readouterr().err
    assert "cannot be brought by a command" in told
    assert f"Put it into {tmp_path / 'nu_nerf'}" in told
    assert main(["get", "fox", "into=here"]) == 1
    assert "'into=here' is not understood" in capsys.readouterr().err
    assert main(["get", "--help"]) == 0
    assert catalogue.FOLDER.is_dir()
