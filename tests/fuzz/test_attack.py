"""A few hundred damaged files a run; ``make fuzz`` tries more. Inputs that once failed are kept in ``corpus/``."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtgs.core.arrays import ArrayFileError, read_npy
from rtgs.core.documents import DocumentError, load_toml, load_yaml, parse_json
from rtgs.core.ply_header import PlyHeaderError, check_ply
from tests.fuzz.attack import attack, attempt, case
from tests.fuzz.mutations import MUTATIONS, mutated
from tests.fuzz.readers import READERS
from tests.fuzz.regressions import kept, kept_input

INPUTS = 12  # of each reader


def test_damaged_files_are_taken_as_sound_or_refused_by_name():
    names = list(READERS)
    outcome = attack(names, range(INPUTS * len(names)), lambda line: None)
    assert outcome.failures == []
    assert outcome.total.total() == INPUTS * len(names)
    assert min(outcome.total["accepted"], outcome.total["refused"]) > 50, "the mutations change too much or too little"


@pytest.mark.parametrize("name", READERS)
def test_sound_files_are_accepted(name, tmp_path):
    reader = READERS[name]
    files = reader.make()
    assert set(reader.damaged) <= set(files)
    assert attempt(name, files, reader.damaged[0], tmp_path) == "accepted"


def test_an_input_is_its_number():
    assert case("transforms", 3) == case("transforms", 3)
    assert len({str(case("transforms", number)) for number in range(20)}) > 15


@pytest.mark.parametrize(("name", "number"), kept())
def test_inputs_that_once_failed(name, number, tmp_path):
    assert attempt(name, *kept_input(name, number), tmp_path) in ("accepted", "refused")


SMALL = {
    "a.json": '{"a": [1, {"b": null}], "c": "d"}',
    "a.yaml": "a: &x [1, 2]\nb: *x\n",
    "a.toml": "[a]\nb = [1, 2]\n",
}


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(random=st.randoms(use_true_random=False), name=st.sampled_from(sorted(SMALL)))
def test_documents_of_drawn_mutations(random: Random, name: str, tmp_path):
    path = tmp_path / name
    path.write_bytes(mutated(SMALL[name].encode(), random))
    load = {"a.json": lambda path: parse_json(path.read_bytes()), "a.yaml": load_yaml, "a.toml": load_toml}[name]
    message = "fine"
    try:
        load(path)
    except DocumentError as error:
        message = str(error)
    assert 0 < len(message) < 400


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(random=st.randoms(use_true_random=False))
def test_headers_of_drawn_mutations(random: Random, tmp_path):
    for name, place, check, refusal in (
        ("normals", "a.npy", read_npy, ArrayFileError),
        ("splat", "a.ply", check_ply, PlyHeaderError),
    ):
        path = tmp_path / place
        path.write_bytes(mutated(READERS[name].make()[place], random))
        message = "fine"
        try:
            check(path)
        except refusal as error:
            message = str(error)
        assert 0 < len(message) < 400


@given(st.binary(max_size=200), st.randoms(use_true_random=False), st.sampled_from(MUTATIONS))
def test_mutations_take_any_bytes(data, random, mutation):
    assert isinstance(mutation(data, random), bytes)
