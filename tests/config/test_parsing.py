"""The settings that a dataclass declares, and how values are read for them."""

from dataclasses import MISSING, dataclass, field
from typing import Any, Literal

import pytest

from latentplan.config import UserError
from latentplan.config.parsing import fits, list_settings, option, raise_unknown, read_values


@dataclass(frozen=True)
class Base:
    """A base.

    Attributes:
        size: Size of
            everything.
    """

    size: int = 3


@dataclass(frozen=True)
class Inner(Base):
    """A part.

    Attributes:
        colour: One word.
    """

    colour: Literal["red", "green"] | None = None


@dataclass(frozen=True)
class Outer:
    """A whole.

    Attributes:
        name: Any text.
        weights: Numbers.
        shades: Words.
        mode: A word.
    """

    name: str
    weights: tuple[float, ...] = option((1.0,), separator=",")
    shades: tuple[Literal["light", "dark"], ...] = option(("light",), separator=",")
    mode: str = option("fast", choices=lambda: ["fast", "slow"])
    inner: Inner = field(default_factory=Inner)


def test_list_settings_takes_keys_defaults_and_meanings_from_dataclasses_and_their_bases():
    found = {setting.key: (setting.default, setting.meaning) for setting in list_settings(Outer, "outer.")}
    assert found == {
        "outer.name": (MISSING, "Any text."),
        "outer.weights": ((1.0,), "Numbers."),
        "outer.shades": (("light",), "Words."),
        "outer.mode": ("fast", "A word."),
        "outer.inner.size": (3, "Size of everything."),
        "outer.inner.colour": (None, "One word."),
    }


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("name", "7", "7"),
        ("name", "", ""),
        ("name", "a: [b", "a: [b"),
        ("weights", ["1", "2e1"], (1.0, 20.0)),
        ("inner.size", "100000.0", 100_000),
        ("inner.size", "123456789012345678", 123_456_789_012_345_678),
        ("inner.size", "-4", -4),
        ("inner.colour", "null", None),
        ("inner.colour", "red", "red"),
    ],
)
def test_read_values_gives_values_the_types_of_their_fields(key, text, value):
    found = read_values(list_settings(Outer), {key: text})
    assert found == {key: value} and type(found[key]) is type(value)


@pytest.mark.parametrize(
    ("key", "text", "expected"),
    [
        ("inner.size", "", "inner.size must be a whole number, got ''"),
        ("inner.size", "1e18", "inner.size must be a whole number, got '1e18'"),
        ("inner.size", "[1", "inner.size must be a whole number, got '[1'"),
        ("shades", ["light", "drak"], "each of shades must be one of light, dark, got 'drak'"),
        ("shades", "[light, 3]", "each of shades must be one of light, dark, got '[light, 3]'"),
        ("weights", ["1", "nan"], "weights must be finite numbers, separated by ',', got '1,nan'"),
        ("inner.colour", "gren", "inner.colour must be one of red, green, got 'gren'; did you mean 'green'?"),
        ("inner.sise", "1", "unknown setting 'inner.sise'; did you mean 'inner.size'?"),
        ("mode", "fst", "mode must be one of fast, slow, got 'fst'; did you mean 'fast'?"),
        ("name", None, "name must be text, got None"),
    ],
)
def test_read_values_refuses_wrong_types(key, text, expected):
    with pytest.raises(UserError) as error:
        read_values(list_settings(Outer), {key: text})
    assert str(error.value) == expected


def test_read_values_uses_given_names_in_errors():
    with pytest.raises(UserError, match="^--size must be"):
        read_values(list_settings(Outer), {"inner.size": "x"}, {"inner.size": "--size"})


def test_choices_are_those_of_a_literal_or_an_option():
    found = {setting.key: setting.choices for setting in list_settings(Outer)}
    expected = {"name": (), "weights": (), "shades": (), "mode": ("fast", "slow")}
    expected |= {"inner.size": (), "inner.colour": ("red", "green")}
    assert found == expected


def test_raise_unknown_names_the_nearest_or_all():
    with pytest.raises(UserError, match="^unknown mode 'planer'; did you mean 'planner'\\?$"):
        raise_unknown("mode", "planer", ["planner", "actor"])
    with pytest.raises(UserError, match="^unknown mode 'q'; available: planner, actor$"):
        raise_unknown("mode", "q", ["planner", "actor"])
    with pytest.raises(UserError, match="--help-all lists all"):
        raise_unknown("flag", "q", [f"--{'x' * count}" for count in range(1, 30)])


@pytest.mark.parametrize(
    ("hint", "good", "bad"),
    [
        (int, [0, -3], [True, 1.0, "1", None, 10**18]),
        (float, [0.5, 2, float("inf")], [False, "1", None, 10**18]),
        (bool, [True], [1, None]),
        (str | None, ["", None], [0]),
        (Literal["red", "green"], ["red"], ["blue", ["red"], None]),
        (tuple[int, ...], [(), (1, 2)], [[1], (1.0,), 1]),
        (list[float], [[], [1, 2.0]], [(1.0,), ["x"]]),
        (dict[str, Any], [{}, {"a": [1]}], [{1: 2}, [], {"a": 10**18}]),
    ],
)
def test_fits_compares_values_with_types(hint, good, bad):
    assert all(fits(value, hint) for value in good) and not any(fits(value, hint) for value in bad)
