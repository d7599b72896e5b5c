"""Exit codes, errors of one line, and the device of a command."""

import errno
import os
import signal
import subprocess
import sys

import pytest
import torch

from latentplan.commands.shell import ComputeRequest, run_guarded, search_settings
from latentplan.config import Config, UserError
from latentplan.config.planner import METHODS
from latentplan.planning.search.registry import PLANNERS

REFUSED = "error: the system refused a file or a process"
ALLOCATOR = "error: not enough memory on the device"
LOWER = "lower the sizes that were asked for, or end other programs"


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (UserError("two\nlines"), 2, "error: two lines\n"),
        (
            FloatingPointError("the gradient is not finite\nat update 1"),
            2,
            "error: the gradient is not finite at update 1\n",
        ),
        (OSError(errno.ENAMETOOLONG, "too long", "a" * 300), 2, f"{REFUSED}: '{'a' * 59}...: too long\n"),
        (OSError(errno.ENOSPC, "No space left", "runs/a"), 2, f"{REFUSED}: 'runs/a': No space left\n"),
        (MemoryError(), 2, f"error: not enough memory: {LOWER}\n"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"), 2, f"{ALLOCATOR}: {LOWER}\n"),
        (UserError("unicode \ud800 é"), 2, "error: unicode \\ud800 é\n"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_run_guarded_turns_errors_into_one_line_and_an_exit_code(error, code, line, capsys):
    def fail(argv):
        raise error

    assert run_guarded(fail, []) == code
    assert capsys.readouterr() == ("", line)


@pytest.mark.parametrize("error", [ValueError("a bug"), RuntimeError("a bug"), OSError("without a number")])
def test_run_guarded_lets_bugs_through(error):
    def fail(argv):
        raise error

    with pytest.raises(type(error)):
        run_guarded(fail, [])


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_run_guarded_ends_by_an_ordinary_exit_on_a_signal(number, code):
    before = signal.signal(number, signal.SIG_DFL)
    with pytest.raises(SystemExit) as ended:
        run_guarded(lambda argv: os.kill(os.getpid(), number), [])
    assert ended.value.code == code and signal.signal(number, before) == signal.SIG_DFL


@pytest.mark.parametrize("words", [["train.py", "--help"], ["benchmark.py"]])
def test_scripts_end_silently_when_nobody_reads_their_output(words, root):
    command = [sys.executable, str(root / "scripts" / words[0]), *words[1:]]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    complaint = process.stderr.read()
    assert (process.wait(), complaint) == (141, b"")


@pytest.mark.parametrize("stream", [">&-", "2>&-", ">&- 2>&-", "2>/dev/full"])
@pytest.mark.parametrize(("words", "code"), [("--version", 0), ("bogus", 2)])
def test_exit_code_is_the_same_where_nothing_can_be_printed(stream, words, code):
    command = f"exec {sys.executable} -m latentplan {words} {stream}"
    assert subprocess.run(["sh", "-c", command], capture_output=True).returncode == code


def test_use_device_sets_the_given_threads_else_those_of_the_command():
    before = torch.get_num_threads()
    try:
        assert ComputeRequest(device="cpu", threads=3).use_device(threads=2) == "cpu"
        assert torch.get_num_threads() == 3
        assert ComputeRequest(device="cpu").use_device(threads=2) == "cpu"
        assert torch.get_num_threads() == 2
        assert ComputeRequest(device="cpu").use_device() == "cpu"
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_use_device_takes_cuda_where_it_is_usable(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert ComputeRequest().use_device() == "cpu"
    with pytest.raises(UserError, match="device 'cuda' is not usable here; give --device cpu"):
        ComputeRequest(device="cuda").use_device()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert [ComputeRequest(device=name).use_device() for name in ("auto", "cuda", "cpu")] == ["cuda", "cuda", "cpu"]


@pytest.mark.parametrize("threads", [0, 1025])
def test_compute_request_refuses_thread_counts_out_of_range(threads):
    with pytest.raises(ValueError, match=rf"threads must be in \[1, 1024\], got {threads}"):
        ComputeRequest(threads=threads)


def test_search_settings_take_every_registered_planner(monkeypatch):
    assert set(METHODS) == set(PLANNERS)
    monkeypatch.setitem(PLANNERS, "mine", PLANNERS["cem"])
    assert [search_settings(Config(), {"method": name}).method for name in PLANNERS] == list(PLANNERS)
    with pytest.raises(UserError, match="unknown planner 'mppy'; did you mean 'mppi'"):
        search_settings(Config(), {"method": "mppy"})


@pytest.mark.parametrize("command", ["goals", "distill"])
def test_teaching_refuses_wrong_variables_of_a_launcher(command, checkpoint, assert_refused, monkeypatch):
    monkeypatch.setenv("RANK", "a")  # on which Lightning fails when it is imported
    assert_refused([command, "--checkpoint", checkpoint], "RANK must be a whole number, at least 0, got 'a'")
