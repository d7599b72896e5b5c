"""`benchmark.py collect`: the model of the cost of collection, and its command line."""

import json
from itertools import product
from types import SimpleNamespace

import benchmark
import pytest
from bench.collect import fit, predict, predict_cluster, print_cluster

from latentplan.config import Config

MODEL = {"round": 0.02, "worker": 0.003, "decision": 0.001}
ROW = {"row_bytes": 10_000.0, "weight_bytes": 1_000_000}


def rows(workers, cores, model=MODEL):
    return [
        {"workers": number, "decisions": decisions, "round_s": predict(model, number, decisions, cores)}
        for number, decisions in product(workers, (250, 1000))
    ]


@pytest.mark.parametrize("cores", [2, 16])
def test_fit_finds_the_costs_from_which_the_times_were_made(cores):
    assert fit(rows((1, 2, 4), cores), cores) == pytest.approx(MODEL)


def test_fit_finds_no_cost_below_zero():
    assert min(fit(rows((1, 2, 4), 2, MODEL | {"worker": -0.001}), 2).values()) >= 0.0


def cluster(model=MODEL, **changes):
    sizes = {"learners": 8, "collectors": 256, "update_ms": 10.0, "link_gbit": 10.0, **changes}
    return predict_cluster(model, ROW, Config(), SimpleNamespace(**sizes))


def test_cluster_collects_no_faster_than_its_workers_without_overhead():
    ideal = Config().env.action_repeat * 256 / MODEL["decision"]
    assert cluster()["collected_frames_per_s"] < ideal
    free = cluster({"round": 0.0, "worker": 0.0, "decision": 0.001})
    assert free["collected_frames_per_s"] == pytest.approx(ideal) and free["limits"]["joining"] is None


def test_cluster_has_no_limits_where_a_decision_takes_no_time(capsys):
    found = cluster(MODEL | {"decision": 0.0})
    assert found["bytes_per_s"] is None and set(found["limits"].values()) == {None}
    print_cluster(found, SimpleNamespace(learners=8, collectors=256))
    assert "updates -, network -, joining -" in capsys.readouterr().out


def test_limits_of_a_cluster_grow_with_the_speed_of_their_parts():
    usual = cluster()["limits"]
    assert cluster(update_ms=5.0)["limits"]["updates"] > usual["updates"]
    assert cluster(link_gbit=100.0)["limits"]["network"] == pytest.approx(10.0 * usual["network"])
    assert cluster(MODEL | {"worker": 0.0015})["limits"]["joining"] == pytest.approx(2.0 * usual["joining"])


def test_collect_refuses_too_few_numbers_for_a_fit(capsys):
    assert benchmark.main(["collect", "--workers", "1,2"]) == 2
    assert "--workers must name at least three numbers" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ("--workers 0,1,2", "--workers must be in [1, 256], got 0"),
        ("--workers 1,2,257", "--workers must be in [1, 256], got 257"),
        ("--held-out 0", "--held-out must be in [1, 256], got 0"),
        ("--decisions 0", "--decisions must be at least 1, got 0"),
    ],
)
def test_collect_refuses_counts_out_of_range(capsys, flags, named):
    assert benchmark.main(["collect", *flags.split()]) == 2
    captured = capsys.readouterr()
    assert named in captured.err and captured.out == ""


@pytest.mark.slow
def test_collect_measures_every_number_of_workers(tmp_path):
    flags = "--backends process --domain cartpole --workers 1,2,3 --held-out 4 --decisions 16,32 --rounds 1".split()
    assert benchmark.main(["collect", *flags, "--json", str(tmp_path / "result.json")]) == 0
    measured = json.loads((tmp_path / "result.json").read_text())["backends"]["process"]
    assert [(row["workers"], row["decisions"]) for row in measured["rows"]] == list(product((1, 2, 3, 4), (16, 32)))
    assert all(row["frames_per_s"] > 0.0 and row["row_bytes"] > 64 * 64 * 3 for row in measured["rows"])
