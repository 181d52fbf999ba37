"""``rtgs get`` against a server on this machine: resuming, other files than the listed ones, bad archives."""

from __future__ import annotations

import dataclasses
import hashlib
import http.server
import io
import json
import shutil
import socket
import stat
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from pipelines.cli.main import main
from rtgs.core.errors import RtgsError
from rtgs.fetch import catalogue
from rtgs.fetch.catalogue import Capture, RemoteFile, capture_names, find_capture, read_capture
from rtgs.fetch.get import SOURCE, get_capture
from rtgs.fetch.http import NotReached, download, refuse_address
from rtgs.fetch.unpack import Limits, unpack

PHOTO = bytes(range(256)) * 4000  # a megabyte
DIGEST = hashlib.sha256(PHOTO).hexdigest()


@dataclass
class Site:
    """A server: what it has, how it misbehaves, what it was asked."""

    address: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    etags: dict[str, str] = field(default_factory=dict)
    redirects: dict[str, str] = field(default_factory=dict)
    cut: list[int] = field(default_factory=list)  # bytes after which each of the next answers breaks off
    ranges: bool = True
    lengths: bool = True
    asked: list[tuple[str, str | None]] = field(default_factory=list)  # path, Range

    def file(self, path: str, **values) -> RemoteFile:
        content = self.files.get(path, b"")
        known = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest(), "most": len(content)} | values
        return RemoteFile(path, f"{self.address}/{path}", **known)


class Handler(http.server.BaseHTTPRequestHandler):
    site: Site

    def do_GET(self) -> None:
        site, path, wanted = self.site, self.path.lstrip("/"), self.headers.get("Range")
        site.asked.append((path, wanted))
        if path in site.redirects:
            self.send_response(302)
            self.send_header("Location", site.redirects[path])
            self.end_headers()
            return
        if path not in site.files:
            self.send_error(404)
            return
        content, start, tag = site.files[path], 0, site.etags.get(path, "")
        same = self.headers.get("If-Range") in (None, tag)
        if wanted and site.ranges and same:
            start = int(wanted.removeprefix("bytes=").rstrip("-"))
            if start >= len(content):
                self.send_error(416)
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        else:
            self.send_response(200)
        if site.lengths:
            self.send_header("Content-Length", str(len(content) - start))
        if tag:
            self.send_header("ETag", tag)
        self.end_headers()
        most = site.cut.pop(0) if site.cut else len(content)
        self.wfile.write(content[start : start + most])

    def log_message(self, format: str, *args: object) -> None: ...


@pytest.fixture
def site(monkeypatch) -> Iterator[Site]:
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
    found = Site(files={"a.jpg": PHOTO})
    handler = type("Bound", (Handler,), {"site": found})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        found.address = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield found
        server.shutdown()
        thread.join()


def bring(file: RemoteFile, path: Path) -> str:
    return download(file, path, plain=True, pause=0.0)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*"))


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


def zipped(*members: tuple[str | zipfile.ZipInfo, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return stream.getvalue()


def archive_of(site: Site) -> Capture:
    file = site.file("set.zip", size=None, sha256=None, most=10_000_000)
    return Capture("set", "", "none stated", "page", archive=file)


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
