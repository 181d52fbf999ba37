import json
import os

import pytest
import yaml

from rtgs.core import credentials
from rtgs.core.credentials import hide, redact, words_without_credentials


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("http://me:secret@host:5000/path", "http://***@host:5000/path"),
        ("postgresql+psycopg2://me:se/cr@et?@db/mlflow", "postgresql+psycopg2://***@db/mlflow"),
        ("https://token@host", "https://***@host"),
        ("uri: 'http://me:secret@a' and http://you:secret@b", "uri: 'http://***@a' and http://***@b"),
        ("postgresql://db/x?user=me&password=secret&sslmode=on", "postgresql://db/x?user=me&password=***&sslmode=on"),
        ("https://host/x?X-Api-Key=secret", "https://host/x?X-Api-Key=***"),
        ("http://me:secret@host/a@b", "http://***@host/a@b"),
        ("http://me:secret@a,http://you:secret@b", "http://***@a,http://***@b"),
        ("mysql://me:12/secret@db/x", "mysql://***@db/x"),
        ("http://me:secret@[::1]:5000/a@b", "http://***@[::1]:5000/a@b"),
        ("http://[me:pass]/word@host", "http://***@host"),
        ("http://[::1]:pass/word@host", "http://***@host"),
    ],
)
def test_what_is_secret_is_hidden_and_the_rest_is_kept(text: str, shown: str):
    assert redact(text) == shown
    assert redact(shown) == shown


@pytest.mark.parametrize(
    "text",
    [
        "http://127.0.0.1:5000",
        "http://host:5000/path@x",
        "http://[::1]:5000/path@x",
        "https://[fe80::1%25eth0]/path@x",
        "postgresql://[2001:db8::192.0.2.1]:5432/mlflow@x",
        "s3://bucket/you:me@x",
        "sqlite:////home/me@work/mlflow.db",
        "s3://bucket/path",
        "write to me@work.org",
        "scene.path='/a:b@c'",
        "data:image/png;base64,iVBO==",
    ],
)
def test_what_holds_no_secret_stays(text: str):
    assert redact(text) == text


def test_words_refer_to_the_environment_where_their_values_go(monkeypatch):
    for name in ("RTGS_TRACKING_URI", "RTGS_REMOTE"):
        monkeypatch.setenv(name, "")
    words = ["--multirun", "scene=fox", "++tracking.uri='http://me:secret@host'", "paths.remote=ftp://me:secret@host/x"]
    assert words_without_credentials(words) == [
        *words[:2],
        "++tracking.uri=${oc.env:RTGS_TRACKING_URI}",
        "paths.remote=${oc.env:RTGS_REMOTE}",
    ]
    assert os.environ["RTGS_TRACKING_URI"] == "http://me:secret@host"
    assert os.environ["RTGS_REMOTE"] == "ftp://me:secret@host/x"


def test_words_without_a_secret_are_left_alone(monkeypatch):
    monkeypatch.delenv("RTGS_TRACKING_URI", raising=False)
    words = ["tracking.uri=http://host:5000", "paths.remote=s3://bucket", "scene=fox"]
    assert words_without_credentials(words) == words
    assert "RTGS_TRACKING_URI" not in os.environ


@pytest.mark.parametrize("password", ["pa'ss", "12345678", 'pa"ss', "pa ss", "p a'' s\\s", "pa/ss@x", "12/pa'ss"])
def test_passwords_with_any_signs_go_to_the_environment_and_are_hidden_in_every_text(password: str, monkeypatch):
    monkeypatch.setenv("RTGS_TRACKING_URI", "")
    uri = f"postgresql://me:{password}@host/db"
    shown = "postgresql://***@host/db"
    words = [f"tracking.uri={uri}"]
    if "\\" not in password:
        words.append("tracking.uri='" + uri.replace("'", "\\'") + "'")
    for word in words:
        assert words_without_credentials([word]) == ["tracking.uri=${oc.env:RTGS_TRACKING_URI}"]
        assert os.environ["RTGS_TRACKING_URI"] == uri
    assert redact(f"no answer from {uri}!") == f"no answer from {shown}!"
    content = {"tracking": {"uri": uri, "long": "words " * 9 + uri}}
    assert yaml.safe_load(redact(yaml.safe_dump(content)))["tracking"]["uri"] == shown
    for text in (yaml.safe_dump(content, width=10), json.dumps(content), repr(content)):
        assert "ss@" not in redact(text)
        assert redact(text).count("***@host") == 2


def test_secrets_of_a_known_address_are_hidden_wherever_they_stand(monkeypatch):
    monkeypatch.setattr(credentials, "_addresses", set())
    text = "password 'long secret%21' of me is wrong; long secret! too, oblong secret! not"
    assert redact(text) == text
    hide("s3://me:long secret%21@host/x?token=it's secret&b=1")
    assert redact(text) == "password '***' of me is wrong; *** too, oblong secret! not"
    assert redact("s3://host/x?token=it's secret&b=1") == "s3://host/x?token=***&b=1"
    hide("ftp://me:eightone@host")
    assert redact("is eightone it?") == "is *** it?"
    hide("ftp://me:run@host")  # short: a word of any text
    assert redact("rtgs run me:run@host") == "rtgs run ***@host"
    hide("http://host:5000")
    assert len(credentials._addresses) == 3
