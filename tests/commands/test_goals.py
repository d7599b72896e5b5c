"""`latentplan goals`: errors of one line."""

import pytest


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ((), ("--checkpoint",)),
        (("--checkpoint", "nothing"), ("nothing",)),
        (("--checkpoint", "nothing", "--updats", "3"), ("--updats", "--updates")),
        (("--checkpoint", "nothing", "--updates", "0"), ("--updates must be in [1, 1000000000], got 0",)),
        (("--checkpoint", "nothing", "--updates", "1.5"), ("--updates", "whole number", "'1.5'")),
        (("--checkpoint", "nothing", "--minutes", "nan"), ("--minutes", "number", "'nan'")),
        (("--checkpoint", "nothing", "--minutes", "-1"), ("--minutes", "above 0")),
        (("--checkpoint", "nothing", "--entropy-scale", "-1"), ("--entropy-scale ", "at least 0")),
        (("--checkpoint", "nothing", "--threads", "0"), ("--threads", "[1, 1024]", "got 0")),
        (("--checkpoint", "nothing", "--device", "cud"), ("'cud'", "'cuda'")),
        (("--resume", "nothing"), ("nothing to resume in nothing",)),
        (("--resume", "nothing", "--minutes", "null"), ("--minutes cannot be null with --resume",)),
        (("--resume", "nothing", "--starts", "3"), ("--starts", "--updates")),
    ],
)
def test_goals_refuses_bad_flags_in_one_line(flags, words, assert_refused):
    assert_refused(["goals", *flags], *words)
