"""`benchmark.py collect`: the model of the cost of collection, and its command line."""

import json
from itertools import product
from types import SimpleNamespace

import benchmark
import pytest
from bench import collect
from bench.collect import fit, predict, predict_cluster, print_cluster

from latentplan.config import Config, extras
from latentplan.training.collection import crew

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
        ("--workers 1,2,4 --held-out 3,4", "--held-out must name other numbers than --workers, got 4 in both"),
        ("--decisions 0", "--decisions must be at least 1, got 0"),
    ],
)
def test_collect_refuses_counts_out_of_range(capsys, flags, named):
    assert benchmark.main(["collect", *flags.split()]) == 2
    captured = capsys.readouterr()
    assert named in captured.err and captured.out == ""


def test_collect_refuses_a_kind_of_worker_that_does_not_exist(capsys):
    assert benchmark.main(["collect", "--backends", "process,dask"]) == 2
    assert capsys.readouterr().err == "error: each of --backends must be one of process, ray, got 'dask'\n"


def test_collect_refuses_an_address_that_no_worker_uses(capsys):
    assert benchmark.main(["collect", "--backends", "process", "--ray-address", "10.0.0.1:6379"]) == 2
    assert "--ray-address has no effect here: name ray in --backends too" in capsys.readouterr().err


def test_collect_asks_for_ray_before_it_measures(capsys, monkeypatch):
    found = extras.util.find_spec
    monkeypatch.setattr(extras.util, "find_spec", lambda name: None if name == "ray" else found(name))
    monkeypatch.setattr(collect, "measure", lambda *_: pytest.fail("measured"))
    assert benchmark.main(["collect", "--domain", "cartpole"]) == 2
    assert "--backends ray needs ray, which is not installed" in capsys.readouterr().err


@pytest.mark.parametrize(("backend", "expected"), [("process", None), ("ray", "10.0.0.1:6379")])
def test_only_workers_of_ray_get_the_address_of_the_cluster(monkeypatch, backend, expected):
    class Made(Exception):
        pass

    def make_worker(config, *_):
        raise Made(config.run.ray_address)

    monkeypatch.setattr(crew, "make_worker", make_worker)
    request = collect.Request(ray_address="10.0.0.1:6379")
    with pytest.raises(Made) as made:
        next(collect.measure(Config(), request, backend))
    assert made.value.args == (expected,)


@pytest.mark.slow
def test_collect_measures_every_number_of_workers(tmp_path):
    flags = "--backends process --domain cartpole --workers 1,2,3 --held-out 4 --decisions 16,32 --rounds 1".split()
    assert benchmark.main(["collect", *flags, "--json", str(tmp_path / "result.json")]) == 0
    measured = json.loads((tmp_path / "result.json").read_text())["backends"]["process"]
    assert [(row["workers"], row["decisions"]) for row in measured["rows"]] == list(product((1, 2, 3, 4), (16, 32)))
    assert all(row["frames_per_s"] > 0.0 and row["row_bytes"] > 64 * 64 * 3 for row in measured["rows"])
