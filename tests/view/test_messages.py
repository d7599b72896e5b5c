"""Requests of the page are checked before anything changes, and messages are JSON that every browser reads."""

import base64
import json

import numpy as np
import pytest

from latentplan.config import UserError
from latentplan.reporting.page import encode_png
from latentplan.view.messages import describe_future, describe_moment, describe_settings, obey, write
from latentplan.view.pace import Pace


def ask(session, **request):
    return obey(session, json.dumps(request))


def test_changeschanges_the_settings_and_answers_with_them(session):
    session.decide()
    answers = ask(session, horizon="2", num_samples="20", deadline_ms="250", objective=" cart -> 0.8 ")
    assert dict(session.settings.planner) == {"horizon": 2, "num_samples": 20, "deadline_ms": 250.0}
    assert session.agent.controller.planner.horizon == 2 and session.settings.objective == "cart -> 0.8"
    settings = answers[0]["settings"]
    assert settings["search"]["horizon"] == 2 and settings["search"]["num_iterations"] is None
    assert settings["own"]["num_iterations"] == 2 and settings["objective"] == "cart -> 0.8"


def test_empty_text_takes_the_settings_of_the_agent_again(session):
    ask(session, horizon="2", objective="cart -> 0.8", constraint="cart < 1", mode="gated")
    ask(session, horizon=" ", objective="", constraint="", mode="planner")
    assert (session.settings.objective, session.settings.constraint) == (None, None)
    assert not session.settings.planner and session.search.horizon == 3


def test_push_reset_and_picture_are_obeyed(session):
    session.decide()
    assert ask(session, push=session.weight) == []
    assert session.env.physics.data.xfrc_applied.any()
    ask(session, reset=True)
    assert session.decide().episode == 2
    assert ask(session, picture="camera")[0]["picture"]["name"] == "picture-1.png"
    sent = encode_png(np.zeros((64, 64, 3), np.uint8))
    assert ask(session, picture=base64.b64encode(sent).decode())[0]["picture"]["name"] == "picture-2.png"
    assert session.pictures.contents["picture-2.png"] == sent


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"picture": "camera", "objective": "goal:picture-2.png"}', "there is no goal picture"),
        ('{"picture": "camera", "horizon": "long"}', "horizon"),
        ('{"objective": "cart -> 0.8", "picture": "camera", "push": 1e9}', "ten times the weight"),
        ("", "JSON object"),
        ("[1]", "JSON object"),
        ("{", "JSON object"),
        ("[" * 100_000, "JSON object"),
        ('{"objektive": "cart"}', "'objective'"),
        ('{"objective": 3}', "objective must be text"),
        ('{"horizon": "long"}', "horizon"),
        ('{"horizon": "0"}', "horizon must be a whole number"),
        ('{"horizon": "1e99"}', "horizon"),
        ('{"num_samples": "1000000000000"}', "num_samples"),
        ('{"deadline_ms": "nan"}', "deadline_ms"),
        ('{"mode": "planer"}', "'planner'"),
        ('{"mode": ""}', "mode"),
        ('{"push": "far"}', "push must be a finite number"),
        ('{"push": NaN}', "push must be a finite number"),
        (f'{{"push": 1{"0" * 400}}}', "push must be a finite number"),
        ('{"push": true}', "push must be a finite number"),
        ('{"push": 1e9}', "ten times the weight"),
        ('{"picture": "???"}', "base64"),
        ('{"picture": 3}', "base64"),
        ('{"picture": "R0lG"}', "PNG file"),
    ],
)
def test_changesthat_cannot_be_followed_is_refused_in_one_line(session, text, words):
    session.decide()
    before, agent = session.settings, session.agent
    with pytest.raises(UserError) as error:
        obey(session, text)
    assert words in str(error.value) and "\n" not in str(error.value)
    assert session.settings == before and session.agent is agent
    assert not session.pictures.contents and not session.env.physics.data.xfrc_applied.any()
    assert session.decide().decision == 1


def test_messages_are_json_without_special_numbers(session):
    moment, pace = session.decide(looks_ahead=True), Pace(0.04)
    for message in (describe_moment(moment, pace), describe_future(moment, moment.future, pace)):
        read = json.loads(write(message), parse_constant=pytest.fail)
        assert read.keys() == message.keys()
    assert json.loads(write(describe_settings(session)))["settings"]["pushed_body"] == "cart"
    assert write({"a": [float("nan"), float("inf"), 1.23456789]}) == '{"a": [null, null, 1.2346]}'


@pytest.mark.parametrize(
    ("changes", "limit"), [({}, 6.0), ({"objective": "cart -> 0.8"}, None), ({"mode": "gated"}, None)]
)
def test_settings_have_the_surprise_limit_where_it_has_an_effect(make_session, changes, limit):
    session = make_session(planner={"surprise_limit": 6.0})
    ask(session, **changes)
    assert describe_settings(session)["settings"]["surprise_limit"] == limit


def test_settings_tell_the_page_which_pictures_are_too_large_to_send(session):
    settings = describe_settings(session)["settings"]
    with pytest.raises(UserError) as error:
        session.pictures.add(b"x" * (settings["largest_picture"] + 1))
    assert settings["picture_rule"] == str(error.value)


def test_moment_names_every_quantity_of_the_settings(session):
    moment = describe_moment(session.decide(), Pace(0.04))["moment"]
    assert moment["quantities"].keys() == describe_settings(session)["settings"]["units"].keys()
    assert moment["frame"].startswith("data:image/png;base64,")
