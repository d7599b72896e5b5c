"""Flags made of a dataclass: spellings, types, repeated flags, errors and help."""

import dataclasses
import importlib
import random
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from latentplan.commands.flags import format_flags, list_flags, overrides, read_request
from latentplan.commands.main import COMMANDS
from latentplan.config import Config, DistillConfig, GoalsConfig, PlannerConfig, UserError
from latentplan.config.checks import at_least
from latentplan.config.parsing import option


@dataclass(frozen=True)
class Request:
    """The request of the tests.

    Attributes:
        checkpoint: Folder of something.
        num_episodes: Episodes, of which 100 % are played.
        rule: Rule that must hold.
        seeds: Seeds.
        json: Result.
        csv: Table.
        resume: Folder to continue.
        planner: Search.
        settings: Distillation.
    """

    RESUMABLE = ("--num-episodes",)
    NOTES = "A note."

    checkpoint: Path = option(metavar="DIR")
    num_episodes: int = 10
    rule: str | None = option(None, join="; ")
    seeds: tuple[int, ...] = option((0, 1), separator=",")
    json: Path | None = option(None, metavar="FILE", is_output=True)
    csv: Path | None = option(None, metavar="FILE", is_output=True, is_rare=True)
    resume: Path | None = None
    planner: dict[str, Any] = overrides(PlannerConfig, {"horizon": "--far"}, prefix="planner.")
    settings: dict[str, Any] = overrides(DistillConfig)

    def __post_init__(self):
        at_least(self, num_episodes=1)
        DistillConfig(**self.settings)


def read(line, **replaced):
    return read_request(Request, ["--checkpoint", "agent", *line.format(**replaced).split()])


def test_read_request_takes_both_spellings_of_a_value():
    assert read("--num-episodes 3") == read("--num-episodes=3") == Request(Path("agent"), num_episodes=3)
    assert read_request(Request, ["--checkpoint=a=b c", "--rule", "-x > 1"]) == Request(Path("a=b c"), rule="-x > 1")
    assert read("--rule= --seeds=3").rule == ""


def test_read_request_takes_the_last_of_a_repeated_flag():
    assert read("--num-episodes x --num-episodes 3 --num-episodes=4").num_episodes == 4
    assert read("--far 3 --planner.horizon 4").planner == read("--planner.horizon 3 --far 4").planner == {"horizon": 4}


def test_read_request_joins_values_of_a_repeated_flag_that_says_so():
    assert read("--rule a --rule=b --rule c").rule == "a; b; c"


def test_read_request_splits_lists_into_distinct_items():
    assert read_request(Request, ["--checkpoint", "a", "--seeds", "2, 1,2,,1e1"]).seeds == (2, 1, 10)


def test_read_request_takes_the_items_of_a_list_as_words_too():
    assert (
        read("--seeds 2 1 --num-episodes 3")
        == read("--num-episodes 3 --seeds 2,1")
        == read("--seeds 2, 1 {n}", n="--num-episodes=3")
    )
    assert read("--seeds 5 --seeds 2 1").seeds == (2, 1)


def test_read_request_takes_an_empty_list_where_it_is_the_default_or_a_setting_of_a_run():
    @dataclass(frozen=True)
    class Lists:
        """Lists.

        Attributes:
            earlier: Files.
            settings: Settings of a run.
        """

        earlier: tuple[str, ...] = option((), separator=",")
        settings: dict[str, Any] = overrides(Config)

    request = read_request(Lists, ["--earlier", "[]", "--run.logger", "[]"])
    assert request == Lists((), {"run": {"logger": ()}})


def test_read_request_keeps_only_the_given_settings_of_another_dataclass():
    request = read("--planner.min_std 1e-3 --updates 2e2 --learning-rate 1 --minutes null")
    assert request.planner == {"min_std": 1e-3}
    assert request.settings == {"updates": 200, "learning_rate": 1.0, "minutes": None}
    assert type(request.settings["updates"]) is int and type(request.settings["learning_rate"]) is float


def test_read_request_tries_outputs_and_takes_where_links_lead(tmp_path):
    (tmp_path / "link.json").symlink_to("target.json")
    assert read("--json {path}/link.json", path=tmp_path).json == tmp_path / "target.json"
    assert [path.name for path in tmp_path.iterdir()] == ["link.json"]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("--num-episods 3", "unknown flag '--num-episods'; did you mean '--num-episodes'?"),
        ("--num_episodes 3", "unknown flag '--num_episodes'; did you mean '--num-episodes'?"),
        ("--num 3", "unknown flag '--num'"),
        ("--planer.horizon=3", "unknown flag '--planer.horizon'; did you mean '--planner.horizon'?"),
        ("--planner {{horizon:3}}", "unknown flag '--planner'"),
        ("--num-episodes.x 3", "unknown flag '--num-episodes.x'; did you mean '--num-episodes'?"),
        ("--hlp", "unknown flag '--hlp'; did you mean '--help'?"),
        ("--help=1", "--help takes no value: give --help alone"),
        ("--print-config=true", "--print-config takes no value: give --print-config alone"),
        ("--version=", "--version takes no value: give --version alone"),
        ("--qqq 1", "unknown flag '--qqq'; --help-all lists all"),
        ("--num-episodes", "flag --num-episodes needs a value"),
        ("--num-episodes --seeds 3", "flag --num-episodes needs a value"),
        ("--num-episodes= ", "--num-episodes must be a whole number, got ''"),
        ("--num-episodes 0", "--num-episodes must be at least 1, got 0"),
        ("--num-episodes é", "--num-episodes must be a whole number, got 'é'"),
        ("--num-episodes 1e99", "--num-episodes must be a whole number, got '1e99'"),
        ("--far x", "--far must be a whole number, got 'x'"),
        ("--planner.min_std nan", "--planner.min_std must be a finite number, got 'nan'"),
        ("--relabel-share 2", "--relabel-share must be in [0.0, 1.0], got 2.0"),
        ("--seeds ,", "--seeds must name at least one, separated by ',', got ','"),
        ("--seeds []", "--seeds must name at least one, separated by ',', got '[]'"),
        ("--seeds 1 x", "--seeds must be whole numbers, separated by ',', got '1,x'"),
        ("--seeds=1 2", "unexpected argument '2'"),
        ("--seeds --num-episodes 3", "flag --seeds needs a value"),
        ("--seeds 1,x", "--seeds must be whole numbers, separated by ',', got '1,x'"),
        ("cartpole", "unexpected argument 'cartpole'; settings are given as --name value"),
        ("-x 3", "unexpected argument '-x'"),
        ("--json nowhere/result.json", "--json: there is no folder 'nowhere'"),
        ("--json a.out --csv ./a.out", "--json and --csv name the same file; give two"),
        ("--resume run --seeds 3", "--checkpoint cannot be given with --resume; only --num-episodes can"),
        ("--planner.start policy", "--planner.start no longer exists: a search starts from the shifted previous plan"),
    ],
)
def test_read_request_refuses_bad_flags(line, expected):
    with pytest.raises(UserError) as error:
        read(line)
    assert expected in str(error.value) and "\n" not in str(error.value)


def test_read_request_names_a_flag_that_is_missing():
    with pytest.raises(UserError, match="^flag --checkpoint is missing; give the folder of something$"):
        read_request(Request, [])


def test_read_request_keeps_a_first_word_in_capitals_of_a_flag_that_is_missing():
    with pytest.raises(UserError, match="^flag --space is missing; give the YAML file of the settings"):
        read_request(importlib.import_module(COMMANDS["sweep"].module).Request, [])


def test_format_flags_shows_meaning_value_and_default_of_each_common_flag():
    text = format_flags(Request, "tool", "Do something.", every_flag=False)
    assert text.startswith("usage: tool --checkpoint DIR [--name value ...]\n\nDo something.\n")
    for line in (
        "--checkpoint DIR ",
        "--num-episodes N ",
        "Episodes, of which 100 % are played. (default: 10)",
        "--seeds A,B,... ",
        "Seeds. (default: 0,1)",
        "--far, --planner.horizon N ",
        "--rounds N ",
        "--help-all ",
        "With --resume only --num-episodes may be given. A note.",
    ):
        assert line in text, line
    for flag in ("--csv", "--planner.min_std", "--plan-batch"):  # rare flags
        assert flag not in text
        assert f"  {flag} " in format_flags(Request, "tool", "Do something.", every_flag=True)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_flag_of_a_command_has_a_meaning(name):
    flags = list_flags(importlib.import_module(COMMANDS[name].module).Request)
    assert all(flag.setting.meaning for flag in flags)
    spellings = [spelling for flag in flags for spelling in flag.names]
    assert len(spellings) == len(set(spellings))


@pytest.mark.parametrize(("name", "kind"), [("distill", DistillConfig), ("goals", GoalsConfig)])
def test_command_has_a_flag_of_the_right_type_for_every_setting(name, kind):
    fields = {field.name: field.default for field in dataclasses.fields(kind)}
    values = dict.fromkeys(fields, "3") | ({"relabel_share": "1"} if name == "distill" else {})
    argv = [word for setting, value in values.items() for word in (f"--{setting.replace('_', '-')}", value)]
    request = importlib.import_module(COMMANDS[name].module).Request
    settings = read_request(request, ["--checkpoint", "x", *argv]).settings
    assert {setting: float(value) for setting, value in values.items()} == settings
    for setting, default in fields.items():
        assert type(settings[setting]) is type(1.0 if default is None else default)  # only minutes may be None


def test_random_flags_never_end_in_a_traceback():
    fuzz(seed=0, rounds=20)


@pytest.mark.soak
def test_many_random_flags_never_end_in_a_traceback():
    fuzz(seed=1, rounds=2_000)


def fuzz(seed, rounds):
    """Read random flags and values of every command: each gives a request or a UserError, nothing else."""
    draw = random.Random(seed)
    values = ["", "0", "-1", "1e999", ".nan", "nan", "[]", "[1", "{a: 1}", "null", "true", "x", "@", "é", "1" * 400]
    values += ["--", "a=b", "%", "-x", ",", "1,2", "~", "*a", "&a [*a]", "!!python/object:os.system {}", "[" * 200]
    for command in COMMANDS.values():
        request = importlib.import_module(command.module).Request
        flags = [name for flag in list_flags(request) for name in flag.names] + ["--nonsense"]
        for _ in range(rounds):
            argv = [word for _ in range(draw.randint(1, 3)) for word in (draw.choice(flags), draw.choice(values))]
            try:
                assert isinstance(read_request(request, argv), request)
            except UserError as error:
                assert str(error)


@dataclass
class Viewing:
    """What an agent sees.

    Attributes:
        cameras: Names.
        seed: Seed.
    """

    cameras: tuple[str, ...] = option((), separator=",")
    seed: int = 0


@pytest.mark.parametrize("words", [["0", "left"], ["0,left"], ['["0", "left"]']])
def test_several_words_are_the_items_of_a_flag(words):
    for line in (["--cameras", *words, "--seed", "3"], ["--seed", "3", "--cameras", *words]):
        assert read_request(Viewing, line) == Viewing(("0", "left"), 3)
    with pytest.raises(UserError, match="--cameras needs a value"):
        read_request(Viewing, ["--cameras", "--seed", "3"])
