"""Latencies: files of durations, and the charges of decisions and plans."""

import json

import pytest

from latentplan.config import UserError
from latentplan.evaluation.clock import Latency, read_latency


def read(tmp_path, text):
    path = tmp_path / "latency.json"
    path.write_text(text)
    return read_latency(str(path))


@pytest.mark.parametrize("text", ["[5, 7.5]", '{"decision_ms": [5, 7.5]}', "5\n7.5\n", "\n5\n\n7.5"])
def test_read_latency_reads_every_format(tmp_path, text):
    latency = read(tmp_path, text)
    assert latency.decision_ms.tolist() == latency.plan_ms.tolist() == [5.0, 7.5]
    assert latency.is_replayed
    assert latency.name.endswith("latency.json")


def test_read_latency_takes_a_single_number(tmp_path):
    assert read(tmp_path, "12\n").decision_ms.tolist() == [12.0]


def test_read_latency_reads_durations_of_plans(tmp_path):
    latency = read(tmp_path, '{"decision_ms": [1], "plan_ms": [30, 40]}')
    assert (latency.decision_ms.tolist(), latency.plan_ms.tolist()) == ([1.0], [30.0, 40.0])


def test_charges_are_the_measured_times_when_latency_is_measured():
    decision, plan = read_latency("measured").charges(seed=0)
    assert (decision(3.25), plan(7.5)) == (3.25, 7.5)
    assert not Latency().is_replayed


def test_charges_depend_on_the_seed_and_cover_the_distribution(tmp_path):
    latency = read(tmp_path, json.dumps(list(range(10))))

    def drawn(seed):
        decision, _ = latency.charges(seed)
        return [decision(1000.0) for _ in range(200)]

    assert drawn(1) == drawn(1) != drawn(2)
    assert set(drawn(1)) == set(range(10))


def test_charges_of_decisions_are_independent_of_the_number_of_plans(tmp_path):
    latency = read(tmp_path, json.dumps(list(range(10))))
    alone, _ = latency.charges(0)
    decision, plan = latency.charges(0)
    expected = [alone(0.0) for _ in range(20)]
    assert expected == [decision(0.0) for _ in range(20) if plan(0.0) >= 0.0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "at least one number"),
        ("[]", "at least one number"),
        ("[1, -2]", "got -2"),
        ("1\nnan\n", "got nan"),
        ("[NaN]", "got nan"),
        ("[Infinity]", "got inf"),
        ('["5"]', "got '5'"),
        ("[true]", "got True"),
        ("five", "one number per line"),
        ("[" * 100_000, "one number per line"),
        ('{"p50": 3}', "decision_ms"),
        ('{"decision_ms": {"p50": 3}}', "must be a list"),
        ('{"decision_ms": [1], "plan_ms": []}', "plan_ms must be a list"),
    ],
)
def test_read_latency_refuses_files_without_durations(tmp_path, text, words):
    with pytest.raises(UserError, match="latency.json") as error:
        read(tmp_path, text)
    assert words in str(error.value)


def test_read_latency_names_a_file_that_cannot_be_read(tmp_path):
    for path in (tmp_path / "no-such-file", tmp_path):
        with pytest.raises(UserError, match=str(path)):
            read_latency(str(path))
