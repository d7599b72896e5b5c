"""Settings that earlier versions had or lacked: read with the meaning that they had then, or refused with advice."""

import dataclasses
import json

import pytest

from latentplan.config import Config, UserError, from_dict, to_dict
from latentplan.config.earlier import ADDED, REMOVED, as_saved, drop_removed
from latentplan.config.files import build_config, read_config, to_yaml
from latentplan.config.planner import SearchOptions


@pytest.mark.parametrize("key", REMOVED)
def test_drop_removed_drops_the_accepted_value_only(key):
    section, name = key.split(".")
    assert drop_removed(section, {name: REMOVED[key].accepted, "kept": 1}) == {"kept": 1}
    with pytest.raises(UserError, match=f"{key} no longer exists, got 'other': {REMOVED[key].advice}"):
        drop_removed(section, {name: "other"})


@pytest.mark.parametrize("key", REMOVED)
def test_saved_settings_load_when_the_removed_one_had_no_effect(key, tmp_path):
    section, name = key.split(".")
    assert name not in to_dict(Config())[section]
    saved = to_dict(Config())
    saved[section][name] = REMOVED[key].accepted
    (tmp_path / "config.yaml").write_text(to_yaml(saved))
    assert from_dict(saved) == build_config(saved) == read_config(tmp_path / "config.yaml") == Config()


@pytest.mark.parametrize("key", REMOVED)
def test_saved_settings_are_refused_with_advice_when_the_removed_one_had_an_effect(key, tmp_path):
    section, name = key.split(".")
    saved = {section: {name: 0.5}}
    (tmp_path / "config.yaml").write_text(to_yaml(saved))
    for load in (from_dict, build_config, lambda _: read_config(tmp_path / "config.yaml")):
        with pytest.raises(UserError, match=REMOVED[key].advice):
            load(saved)


def test_later_settings_of_saved_files_stand_for_what_earlier_versions_did(tmp_path):
    """A program that knows a setting saves it, so its own value is kept."""
    known, earlier, expected = to_dict(Config()), to_dict(Config()), to_dict(Config())
    for section, settings in ADDED.items():
        assert as_saved(section, known[section]) == known[section]
        expected[section] |= settings
        for name in settings:
            del earlier[section][name]
    (tmp_path / "config.yaml").write_text(to_yaml(earlier))
    assert expected != known
    assert to_dict(from_dict(earlier)) == to_dict(read_config(tmp_path / "config.yaml")) == expected
    assert to_dict(from_dict(known)) == known


def test_shipped_agents_search_without_options_that_came_later(root):
    """An option of the search that an agent was saved without has no effect, as in the planning library."""
    agents = list(root.glob("checkpoints/*/info.json"))
    assert agents
    for info in agents:
        saved = json.loads(info.read_text())["config"]
        planner = from_dict(saved).planner
        for field in dataclasses.fields(SearchOptions):
            if field.name not in saved["planner"]:
                assert getattr(planner, field.name) == field.default, f"{info.parent.name}: {field.name}"
