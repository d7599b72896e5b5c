"""Hostile command lines and files are refused in one line, before any work begins and without running any of it."""

import pickle
import shutil
import sys

import pytest
import yaml

from latentplan.commands.main import main
from latentplan.training import run


@pytest.fixture(scope="module")
def hostile(root):
    """The module of the benchmark that tries the hostile inputs."""
    sys.path.insert(0, str(root / "scripts"))
    try:
        from bench import hostile

        return hostile
    finally:
        sys.path.remove(str(root / "scripts"))


@pytest.fixture(scope="module")
def inputs(hostile):
    """The module of the hostile inputs."""
    return sys.modules["bench.hostile_inputs"]


@pytest.fixture(scope="module")
def folder(inputs, checkpoint, tmp_path_factory):
    folder = tmp_path_factory.mktemp("hostile")
    inputs.write_files(folder, checkpoint)
    return folder


@pytest.fixture
def no_work(monkeypatch):
    """Fails a test in which a run starts its worker."""

    def start(*_):
        raise AssertionError("a worker was started")

    monkeypatch.setattr(run, "make_worker", start)


@pytest.mark.usefixtures("no_work")
def test_every_hostile_input_is_refused_in_one_line(hostile, inputs, folder, checkpoint, capfd, monkeypatch):
    monkeypatch.chdir(folder.parent)
    cases = inputs.list_cases()
    assert len(cases) >= 150
    wrong = []
    for name, words in cases.items():
        argv = [word.replace("{folder}", str(folder)).replace("{agent}", str(checkpoint)) for word in words]
        (folder / inputs.MARK).unlink(missing_ok=True)
        try:
            code = main(argv)
        except (Exception, SystemExit) as error:  # every input is tried, and all that escaped are reported
            wrong.append(f"{name}: {type(error).__name__}: {str(error)[:200]}")
            capfd.readouterr()
            continue
        out, err = capfd.readouterr()
        if (folder / "run").exists():
            wrong.append(f"{name}: a run folder was made")
            shutil.rmtree(folder / "run")
        if problem := hostile.judge(code, out, err):
            wrong.append(f"{name}: {problem}: {err[:300]}")
        if (folder / inputs.MARK).exists():
            wrong.append(f"{name}: it was executed")
    assert not wrong, "\n".join(wrong)


PAYLOADS = {"pickle": pickle.loads, "system": yaml.unsafe_load, "new": yaml.unsafe_load}


@pytest.mark.parametrize("name", PAYLOADS)
def test_payload_would_leave_the_mark_if_it_was_executed(name, inputs, folder):
    (folder / inputs.MARK).unlink(missing_ok=True)
    PAYLOADS[name]((folder / f"{name}.yaml").read_bytes())
    assert (folder / inputs.MARK).exists()
    (folder / inputs.MARK).unlink()


def test_every_payload_names_the_folder(inputs, folder, checkpoint):
    mark = inputs.TOUCH.replace("{folder}", str(folder)).encode()
    for name in ("system", "new", "tag", "pickle", "suite-code", "goals"):
        assert mark in (folder / f"{name}.yaml").read_bytes()
    assert mark in (folder / "weights-pickle" / "weights.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("code", "output", "error", "problem"),
    [
        (2, "", "error: no\n", ""),
        (2, "", "error: " + "x" * 992 + "\n", ""),
        (2, "", "error: " + "x" * 993 + "\n", "a line of 1001 characters"),
        (1, "", "error: no\n", "exit code 1"),
        (2, "yes", "error: no\n", "3 characters of output"),
        (2, "", "no\n", "not one line"),
        (2, "", "error: no\nno\n", "not one line"),
        (2, "", "", "not one line"),
    ],
)
def test_judge_names_what_is_wrong(hostile, code, output, error, problem):
    assert hostile.judge(code, output, error) == problem


def test_benchmark_tries_an_input_in_a_program_of_its_own(hostile, inputs, folder, monkeypatch):
    (folder / inputs.MARK).touch()  # of an earlier input
    refused = hostile.try_input("text", ["train", "--config", str(folder / "text.yaml")], folder)
    assert refused.problem == "" and "must hold sections" in refused.output and refused.processor_seconds > 0.0
    assert hostile.try_input("help", ["--help"], folder).problem == "exit code 0"
    monkeypatch.setattr(hostile, "PROMISED_S", 0.0)
    slow = hostile.try_input("text", ["train", "--config", str(folder / "text.yaml")], folder)
    assert slow.problem.endswith("s of the processor")
