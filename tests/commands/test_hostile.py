"""Hostile command lines and files are refused in one line, before any work begins and without running any of it."""

import sys

import pytest

from latentplan.commands.main import main
from latentplan.training import run


@pytest.fixture(scope="module")
def inputs(root):
    """The module of the hostile inputs."""
    sys.path.insert(0, str(root / "scripts"))
    try:
        from bench import hostile_inputs

        return hostile_inputs
    finally:
        sys.path.remove(str(root / "scripts"))


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
def test_every_hostile_input_is_refused_in_one_line(inputs, folder, checkpoint, capsys, monkeypatch):
    monkeypatch.chdir(folder.parent)
    cases = inputs.list_cases()
    assert len(cases) >= 150
    wrong = []
    for name, words in cases.items():
        argv = [word.replace("{folder}", str(folder)).replace("{agent}", str(checkpoint)) for word in words]
        try:
            code = main(argv)
        except (Exception, SystemExit) as error:  # every input is tried, and all that escaped are reported
            wrong.append(f"{name}: {type(error).__name__}: {str(error)[:200]}")
            capsys.readouterr()
            continue
        out, err = capsys.readouterr()
        if code != 2 or out or not err.startswith("error: ") or err.count("\n") != 1 or len(err) > 1000:
            wrong.append(f"{name}: exit code {code}, {len(err)} characters: {err[:300]}")
    assert not wrong, "\n".join(wrong)
    assert not (folder / inputs.MARK).exists() and not (folder / "run").exists()


def test_benchmark_tries_an_input_in_a_program_of_its_own(inputs, folder, root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "scripts"))
    from bench.hostile import try_input

    refused = try_input("text", ["train", "--config", str(folder / "text.yaml")], folder)
    assert refused.problem == "" and "must hold sections" in refused.output and refused.processor_seconds > 0.0
    assert try_input("help", ["--help"], folder).problem == "exit code 0"
