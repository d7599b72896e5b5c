"""The command line of learning goals: one line for every mistake, and an answer at once."""

import dataclasses

import pytest

from latentplan.commands import goals as learn_goals
from latentplan.config import GoalsConfig


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ((), ("--checkpoint",)),
        (("--checkpoint", "nothing"), ("nothing",)),
        (("--checkpoint", "nothing", "--updats", "3"), ("--updats", "--updates")),
        (("--checkpoint", "nothing", "--updates", "0"), ("--updates", "at least 1")),
        (("--checkpoint", "nothing", "--updates", "1.5"), ("--updates", "whole number", "'1.5'")),
        (("--checkpoint", "nothing", "--minutes", "nan"), ("--minutes", "number", "'nan'")),
        (("--checkpoint", "nothing", "--minutes", "-1"), ("--minutes", "above 0")),
        (("--checkpoint", "nothing", "--entropy-scale", "-1"), ("--entropy-scale ", "at least 0")),
        (("--checkpoint", "nothing", "--threads", "0"), ("--threads", "at least 1")),
        (("--checkpoint", "nothing", "--device", "cud"), ("'cud'", "'cuda'")),
        (("--resume", "nothing"), ("nothing to resume in nothing",)),
        (("--resume", "nothing", "--starts", "3"), ("--starts", "--updates")),
    ],
)
def test_mistakes_are_one_line(flags, words, capsys):
    assert learn_goals.main(list(flags)) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert all(word in captured.err for word in words), captured.err


def test_every_setting_has_a_flag_of_its_type():
    fields = {field.name: field.default for field in dataclasses.fields(GoalsConfig)}
    flags = [word for name in fields for word in (f"--{name.replace('_', '-')}", "1")]
    settings = learn_goals.parse_arguments(["--checkpoint", "x", *flags]).settings
    assert settings.keys() == fields.keys()
    for name, default in fields.items():
        assert type(settings[name]) is type(default if default is not None else 1.0)


def test_help_lists_the_flags_without_torch(run_python, root):
    code = (
        "import runpy, sys\n"
        f"sys.argv = [{str(root / 'scripts' / 'goals.py')!r}, '--help']\n"
        "try: runpy.run_path(sys.argv[0], run_name='__main__')\n"
        "except SystemExit as stop: print('code', stop.code)\n"
        "print('loaded', sorted({'torch', 'lightning', 'mujoco', 'gymnasium', 'numpy'} & set(sys.modules)))\n"
    )
    result = run_python("-c", code)
    assert "code 0" in result.stdout and "loaded []" in result.stdout, result.stderr
    for flag in (
        "--checkpoint",
        "--updates",
        "--starts",
        "--minutes",
        "--out",
        "--seed",
        "--resume",
        "--device",
    ):
        assert f"  {flag} " in result.stdout
