"""`latentplan goals`: its command line, and errors of one line."""

import dataclasses

import pytest

from latentplan.commands.flags import read_request
from latentplan.commands.goals import Request
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
        (("--checkpoint", "nothing", "--threads", "0"), ("--threads", "[1, 1024]", "got 0")),
        (("--checkpoint", "nothing", "--device", "cud"), ("'cud'", "'cuda'")),
        (("--resume", "nothing"), ("nothing to resume in nothing",)),
        (("--resume", "nothing", "--starts", "3"), ("--starts", "--updates")),
    ],
)
def test_goals_refuses_bad_flags_in_one_line(flags, words, assert_refused):
    assert_refused(["goals", *flags], *words)


def test_goals_has_a_flag_for_every_setting():
    fields = {field.name: field.default for field in dataclasses.fields(GoalsConfig)}
    argv = [word for name in fields for word in (f"--{name.replace('_', '-')}", "1")]
    settings = read_request(Request, ["--checkpoint", "x", *argv]).settings
    assert settings.keys() == fields.keys()
    for name, default in fields.items():
        assert type(settings[name]) is type(default if default is not None else 1.0)
