"""What every converter must hold; a new file in `converters/` is tested here without an edit (given a made sequence)."""

from __future__ import annotations

import pickle
from types import ModuleType

import numpy as np
import pytest

from imutool import registry
from imutool.conversion.run import is_general
from imutool.recording import Recording

GROUP = "imutool.converters"
FIRST_NS = 1403636579758560000


DATA_SETS = [key for key in registry.names(GROUP) if not is_general(registry.load(GROUP, key))]


@pytest.mark.parametrize("key", registry.names(GROUP))
def test_the_docstring_begins_with_one_line_of_help(key):
    summary = registry.summary(GROUP, key)
    assert 20 < len(summary) <= 120
    assert summary.endswith(".")


@pytest.fixture(params=DATA_SETS)
def converter(request: pytest.FixtureRequest) -> ModuleType:
    module = registry.load(GROUP, request.param)
    module.KEY = request.param
    return module


@pytest.mark.parametrize("form", ["folder", "zip", "tar", "tar.gz", "archive of one folder"])
def test_every_form_of_a_sequence_reads_as_the_same_recording(converter, make, form):
    files = make.files(converter.KEY)
    source = {
        "folder": lambda: make.folder("one", files),
        "zip": lambda: make.zip("one.zip", files),
        "tar": lambda: make.tar("one.tar", files),
        "tar.gz": lambda: make.tar("one.tar.gz", files),
        "archive of one folder": lambda: make.tar("x.tgz", {f"one/{name}": content for name, content in files.items()}),
    }[form]()
    (recording,) = list(converter.read(source))
    assert isinstance(recording, Recording)
    assert recording.name == "one"
    assert recording.source == source.name
    assert recording.imu_topic == "/imu0"
    assert recording.metadata["imutool"]["format"] == converter.KEY
    assert recording.metadata["imutool"]["sequence"] == "one"
    assert recording.imu.t_ns[0] == FIRST_NS
    assert recording.imu.gyro[3].tolist() == [0.1, -0.2, 0.003]
    assert recording.imu.accel[3].tolist() == [9.003, 0.5, -0.25]
    assert list(recording.truths) == ["/ground_truth/pose"]
    assert recording.truth.t_ns[0] == FIRST_NS
    assert recording.truth.p_wb[2].tolist() == [2.5, -1.5, 0.25]
    assert np.array_equal(recording.truth.q_wb_wxyz[2], [0.6, 0.8, 0.0, 0.0])


def test_a_folder_of_sequences_in_any_form_yields_each(converter, make):
    files = make.files(converter.KEY)
    make.folder("b", files)
    make.zip("a.zip", files)
    make.tar("c.tar", {f"c{n}/{name}": content for n in (1, 2) for name, content in files.items()})
    names = ["a", "b", "c1", "c2"]
    assert [s.name for s in converter.sequences(make.tmp)] == names
    assert [r.name for r in converter.read(make.tmp)] == names


def test_a_sequence_crosses_to_another_process_and_still_reads(converter, make):
    (sequence,) = converter.sequences(make.zip("one.zip", make.files(converter.KEY)))
    again = pickle.loads(pickle.dumps(sequence))
    assert again == sequence
    assert converter.read_sequence(again) == converter.read_sequence(sequence)


def test_exactly_the_data_sets_own_converter_recognises_a_sequence(converter, make):
    source = make.folder("one", make.files(converter.KEY))
    recognising = [
        key
        for key in registry.names(GROUP)
        for module in [registry.load(GROUP, key)]
        if any(is_general(module) or module.recognises(sequence) for sequence in module.sequences(source))
    ]
    assert recognising == [converter.KEY]


def test_a_place_without_sequences_has_none(converter, make):
    (make.tmp / "notes.txt").write_text("nothing here")
    (make.tmp / "empty").mkdir()
    assert converter.sequences(make.tmp) == []
    assert converter.sequences(make.tmp / "notes.txt") == []
    assert list(converter.read(make.tmp)) == []


def test_data_set_and_sensor_are_stated_only_where_the_sequence_shows_them(converter, make):
    own, fetch = {"euroc": "MH_01_easy", "tum_vi": "dataset-room1"}.get(converter.KEY, "one"), converter.KEY == "fetch"
    for name, known in ((own, True), ("my_robot", fetch)):
        (recording,) = converter.read(make.folder(name, make.files(converter.KEY)))
        stated = recording.metadata["imutool"]
        assert ("sensor" in stated, stated.get("dataset")) == (known, converter.KEY if known else None)
