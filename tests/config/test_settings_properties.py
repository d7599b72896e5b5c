"""Laws of settings: valid ones survive every round trip, and no text does anything but become settings or an error."""

import dataclasses
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml
from hypothesis import given
from hypothesis import strategies as st

from latentplan.config import Config, UserError, from_dict, to_dict
from latentplan.config.checks import cut, shown
from latentplan.config.files import SECTIONS, build_config, dump_config, read_config, read_layer
from latentplan.config.parsing import list_settings, read_values

SETTINGS = list_settings(Config)
KEYS = [setting.key for setting in SETTINGS]
plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
values = st.recursive(plain, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3))
numbers = st.integers(1, 40) | st.floats(0.0, 2.0) | st.sampled_from([0, 1, 0.5, 4, 64])


@st.composite
def layers(draw):
    """Values for a few settings, of the kind that each setting may have."""
    layer = {}
    for setting in draw(st.lists(st.sampled_from(SETTINGS), max_size=6, unique_by=lambda setting: setting.key)):
        section, _, name = setting.key.partition(".")
        if setting.choices:
            value = draw(st.sampled_from(setting.choices))
        elif setting.hint is bool:
            value = draw(st.booleans())
        elif setting.hint in (str, str | None):
            value = draw(st.text(max_size=12))
        elif "tuple" in str(setting.hint):
            value = [draw(st.integers(1, 8)), 8]
        else:
            value = draw(numbers)
        layer.setdefault(section, {})[name] = value
    return layer


@given(layers())
def test_settings_survive_every_round_trip(layer):
    try:
        config = build_config(layer)
    except UserError:
        return
    assert from_dict(to_dict(config)) == config
    assert build_config(to_dict(config)) == config
    with TemporaryDirectory() as folder:
        dump_config(config, Path(folder) / "config.yaml")
        assert read_config(Path(folder) / "config.yaml") == config
    for section, fields in layer.items():
        assert set(fields) <= {field.name for field in dataclasses.fields(getattr(config, section))}


@given(st.dictionaries(st.sampled_from(KEYS), values, max_size=4))
def test_any_value_becomes_a_setting_or_a_short_error(given_values):
    layer = {}
    for key, value in given_values.items():
        section, _, name = key.partition(".")
        layer.setdefault(section, {})[name] = value
    try:
        assert isinstance(build_config(layer), Config)
    except UserError as error:
        assert len(str(error)) <= 1000 and "\n" not in str(error).strip()


@given(st.sampled_from(KEYS), st.text(max_size=60))
def test_any_word_of_the_command_line_becomes_a_setting_or_an_error(key, text):
    try:
        found = read_values(SETTINGS, {key: text})
    except UserError as error:
        assert key in str(error)
    else:
        assert set(found) == {key}


@given(
    st.binary(max_size=200) | st.text(max_size=200).map(str.encode) | values.map(lambda v: yaml.safe_dump(v).encode())
)
def test_any_file_becomes_a_layer_or_an_error(content):
    with TemporaryDirectory() as folder:
        path = Path(folder) / "config.yaml"
        path.write_bytes(content)
        try:
            layer = read_layer(path)
        except UserError:
            return
    assert set(layer) <= set(SECTIONS)


@given(values)
def test_shown_repeats_any_value_on_one_short_line(value):
    assert len(shown(value)) <= 63 and "\n" not in shown(value)


@given(st.lists(st.text(alphabet="ab ", min_size=1, max_size=400), max_size=40).map("".join))
def test_cut_keeps_beginning_and_end_of_a_message(message):
    short = cut(message)
    assert len(short) <= 1000 and short[:50] == message[:50] and short[-50:] == message[-50:]
    if len(message) <= 200:
        assert short == message
