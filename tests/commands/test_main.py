"""The command `latentplan`: its table of commands, help, versions, printed settings and completion."""

import hashlib
import json
import re
import shutil
import subprocess
import sys

import pytest
import yaml

from latentplan import __version__
from latentplan.agents.checkpoint import seal_checkpoint
from latentplan.agents.files import write_files
from latentplan.commands.flags import GENERAL_FLAGS
from latentplan.commands.main import COMMANDS, SHELLS, main
from latentplan.config import GoalsConfig
from tests.commands.conftest import CONFIG

HEAVY = "{'torch', 'lightning', 'mujoco', 'dm_control', 'gymnasium', 'cv2', 'numpy'}"


@pytest.mark.parametrize("argv", [[], ["-h"], ["--help"]])
def test_main_lists_every_command(argv, capsys):
    assert main(argv) == 0
    text = capsys.readouterr().out
    for name, command in COMMANDS.items():
        assert f"  {name} " in text and command.summary in text
    assert "--help-all" in text and "--print-config" in text and "--print-completion" in text


@pytest.mark.parametrize("argv", [["--version"], ["train", "--version"], ["doctor", "--version"]])
def test_main_prints_the_version(argv, capsys):
    assert main(argv) == 0
    assert capsys.readouterr().out == f"latentplan {__version__}\n"


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["trian"], "unknown command 'trian'; did you mean 'train'?"),
        (["qqq"], f"unknown command 'qqq'; available: {', '.join(COMMANDS)}"),
        (["--hel"], "unknown command '--hel'"),
        (["doctor", "--fast"], "unknown flag '--fast'"),
        (["export", "--out", "actor.pt2"], "flag --checkpoint is missing"),
        (["export", "--checkpoint", "x", "--out", "a", "--format", "onxx"], "did you mean 'onnx'?"),
        (["--print-completion", "fish"], "unknown shell 'fish'"),
        (["--print-completion"], "unknown shell ''"),
    ],
)
def test_main_refuses_unknown_commands_and_flags_in_one_line(argv, expected, capsys):
    assert main(argv) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert expected in captured.err


def test_help_comes_before_errors_in_other_flags(capsys):
    assert main(["eval", "--qqq", "--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"  {flag} " in text for flag in ("--checkpoint", *GENERAL_FLAGS))
    assert "--planner.horizon" not in text
    assert main(["eval", "--help-all"]) == 0
    assert "  --planner.horizon N " in capsys.readouterr().out


def test_no_command_imports_heavy_libraries_before_it_runs(run_python):
    code = (
        "import sys\nfrom latentplan.commands.main import COMMANDS, main\n"
        "for name in COMMANDS:\n"
        "    assert main([name, '--help']) == main([name, '--help-all']) == 0\n"
        "    assert main([name, '--no-such-flag', '3']) == 2\n"
        "assert main(['train', '--domain', 'walkr']) == main(['train', '--planner.horizon', 'x']) == 2\n"
        "assert main(['train', '--print-config']) == 0\n"
        f"print('loaded', sorted({HEAVY} & set(sys.modules)))\n"
    )
    result = run_python("-c", code)
    assert result.returncode == 0 and result.stdout.splitlines()[-1] == "loaded []", result.stderr


def test_agents_and_their_settings_are_refused_before_torch_is_imported(run_python, checkpoint, tmp_path):
    """Importing torch takes longer than every check of a file, a name or a number."""
    for name in ("info.json", "weights.safetensors"):
        shutil.copytree(checkpoint, tmp_path / name)
        content = bytearray((tmp_path / name / name).read_bytes())
        content[len(content) // 2] ^= 1
        (tmp_path / name / name).write_bytes(content)
    good, missing = ["--checkpoint", str(checkpoint)], ["--checkpoint", str(tmp_path / "missing")]
    damaged = [["--checkpoint", str(tmp_path / name)] for name in ("info.json", "weights.safetensors")]
    words = [[command, *agent] for command in ("eval", "distill", "goals", "export") for agent in (missing, *damaged)]
    words = [[*line, "--out", str(tmp_path / "out.pt2")] if line[0] == "export" else line for line in words]
    for flags in (["--planner.method", "cme"], ["--planner.horizon", "0"], ["--planner.num_samples", "1e12"]):
        words += [["eval", *good, *flags], ["distill", *good, *flags]]
    words += [["eval", *good, flag, "nonsense ->"] for flag in ("--objective", "--constraint")]
    words += [["eval", *good, "--control-hz", "50", "--latency", str(tmp_path)]]
    elsewhere = shutil.copytree(checkpoint, tmp_path / "elsewhere")
    info = json.loads((elsewhere / "info.json").read_text())
    info["config"]["env"]["domain"] = "nowhere"
    (elsewhere / "info.json").write_text(json.dumps(info))
    seal_checkpoint(elsewhere)
    words += [["eval", "--checkpoint", str(elsewhere)]]
    code = (
        "import sys\nfrom latentplan.commands.main import main\n"
        f"for words in {words!r}:\n"
        "    code = main(words)\n"
        f"    print(code, sorted({HEAVY} & set(sys.modules)), words)\n"
    )
    result = run_python("-c", code)
    lines = result.stdout.splitlines()
    assert len(lines) == len(words) == result.stderr.count("\n")
    assert all(line.startswith("2 []") for line in lines), result.stdout


def test_what_is_missing_or_impossible_is_refused_before_torch_is_imported(run_python, checkpoint, tmp_path):
    """The checks of these need NumPy, OpenCV or the free memory, but no torch."""
    weights = (checkpoint / "weights.safetensors").read_bytes()[:1000]
    info = json.loads((checkpoint / "info.json").read_text())
    huge = json.loads(json.dumps(info))
    huge["config"].setdefault("planner", {})["num_samples"] = 10**12
    cut = info | {"sha256": hashlib.sha256(weights).hexdigest()}
    whole = (checkpoint / "weights.safetensors").read_bytes()
    for name, about, content in (("huge", huge, whole), ("cut", cut, weights)):
        (tmp_path / name).mkdir()
        write_files(tmp_path / name, {"info.json": json.dumps(about).encode(), "weights.safetensors": content})
    words = [["eval", "--checkpoint", str(tmp_path / name)] for name in ("huge", "cut")]
    words += [["eval", "--checkpoint", str(checkpoint), "--objective", f"goal:{tmp_path / 'missing.png'}"]]
    words += [[command, "--resume", str(tmp_path)] for command in ("distill", "goals")]
    words += [["train", "--domain", "walker", "--frames", "100", "--run.nodes", "2"]]
    code = (
        "import sys\nfrom latentplan.commands.main import main\n"
        f"for words in {words!r}:\n"
        "    code = main(words)\n"
        "    print(code, 'torch' in sys.modules, words)\n"
    )
    result = run_python("-c", code)
    lines = result.stdout.splitlines()
    assert len(lines) == len(words) == result.stderr.count("\n")
    assert all(line.startswith("2 False") for line in lines), result.stdout + result.stderr


@pytest.mark.parametrize("script", ["train", "eval", "distill", "goals"])
def test_scripts_run_their_command_from_any_folder(script, run_python, root, tmp_path):
    result = run_python(root / "scripts" / f"{script}.py", "--device", "cpuu", cwd=tmp_path)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert "auto, cpu, cuda" in result.stderr or "did you mean" in result.stderr


def test_package_runs_as_a_module_under_the_name_of_the_program(run_python):
    result = run_python("-m", "latentplan", "export", "--help")
    assert result.returncode == 0
    assert result.stdout.startswith("usage: latentplan export --checkpoint DIR --out FILE [--name value ...]")


def test_print_config_prints_the_resolved_settings_and_does_nothing_else(checkpoint, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--domain", "cartpole", "--planner.horizon", "3", "--preset", "cpu", "--print-config"]) == 0
    printed = yaml.safe_load(capsys.readouterr().out)
    assert (printed["env"]["task"], printed["planner"]["horizon"]) == ("swingup", 3)
    assert main(["goals", "--checkpoint", str(checkpoint), "--updates", "3", "--print-config"]) == 0
    settings = yaml.safe_load(capsys.readouterr().out)["settings"]
    assert (settings["updates"], settings["starts"]) == (3, GoalsConfig().starts)
    for command in ("eval", "view", "distill"):  # settings that this machine cannot serve can still be printed
        words = [command, "--checkpoint", str(checkpoint), "--planner.num_samples", "1e12", "--print-config"]
        assert main(words) == 0
        search = yaml.safe_load(capsys.readouterr().out)["planner"]
        assert (search["num_samples"], search["horizon"]) == (10**12, CONFIG.planner.horizon)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["eval", "view", "distill", "goals"])
def test_print_config_refuses_an_agent_that_does_not_exist(command, assert_refused):
    assert_refused([command, "--checkpoint", "nowhere", "--print-config"], "no checkpoint at nowhere")


@pytest.mark.parametrize("command", ["train", "distill", "goals"])
def test_print_config_refuses_a_folder_from_which_nothing_resumes(command, assert_refused):
    assert_refused([command, "--resume", "nowhere", "--print-config"], "nothing to resume in nowhere")


def test_print_config_output_is_a_config_file_that_gives_the_same_settings(capsys, tmp_path):
    assert main(["train", "--domain", "reacher", "--frames", "1e4", "--preset", "cpu", "--print-config"]) == 0
    (tmp_path / "config.yaml").write_text(first := capsys.readouterr().out)
    assert main(["train", "--config", str(tmp_path / "config.yaml"), "--preset", "gpu", "--print-config"]) == 0
    assert capsys.readouterr().out == first


@pytest.mark.parametrize("shell", SHELLS)
def test_print_completion_names_every_command_and_flag(shell, capsys):
    assert main(["--print-completion", shell]) == main([f"--print-completion={shell}"]) == 0
    text = capsys.readouterr().out
    for word in (*COMMANDS, "--planner.horizon", "--run-dir", "--constraint", "background", "--help-all"):
        assert re.search(rf"(?<![\w-]){re.escape(word)}(?![\w-])", text), word


@pytest.mark.skipif(sys.platform == "win32", reason="needs bash")
def test_bash_completion_completes_commands_flags_and_values(capsys):
    assert main(["--print-completion", "bash"]) == 0
    cases = {
        "tr": "train",
        "eval --mod": "--mode",
        "eval --mode ba": "background",
        "train --env.dom": "--env.domain",
    }
    script = capsys.readouterr().out
    for line, expected in cases.items():
        words = ["latentplan", *line.split()]
        ask = f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; _shtab_latentplan; echo ${{COMPREPLY[@]}}"
        result = subprocess.run(["bash", "-c", f"{script}\n{ask}"], capture_output=True, text=True)
        assert result.stdout.split() == [expected], result.stderr
