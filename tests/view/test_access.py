"""Who may open a live view, by the headers of the request."""

import pytest

from latentplan.view.access import Access, is_loopback

OPEN, LOCKED = Access.of("127.0.0.1", 8420), Access.of("0.0.0.0", 8420)
HERE = "127.0.0.1:8420"


def allows(access, query="", *, is_socket=False, **headers):
    return access.refusal(headers, query, is_socket=is_socket) is None


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost", "127.9.9.9"])
def test_loopback_needs_no_token(host):
    assert is_loopback(host) and Access.of(host, 1).token is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.2", "robot.example", ""])
def test_other_interfaces_have_a_random_token(host):
    tokens = {Access.of(host, 1).token for _ in range(5)}
    assert len(tokens) == 5 and all(len(token) >= 40 for token in tokens)


@pytest.mark.parametrize("host", [HERE, "localhost:8420", "[::1]:8420", "localhost"])
def test_loopback_answers_to_its_own_names(host):
    assert allows(OPEN, host=host) and allows(OPEN, host=host, origin=f"http://{host}", is_socket=True)


@pytest.mark.parametrize("host", ["evil.example:8420", "evil.example", "", "127.0.0.1.evil.example", "[x"])
def test_loopback_refuses_a_foreign_name_that_leads_to_it(host):
    assert not allows(OPEN, host=host) and not allows(OPEN, host=host, origin=f"http://{host}", is_socket=True)


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:8421", "null", "", "http://[x"])
def test_websocket_of_another_website_is_refused(origin):
    token = f"token={LOCKED.token}"
    assert not allows(OPEN, host=HERE, origin=origin, is_socket=True)
    assert not allows(LOCKED, token, host="robot:8420", origin=origin, is_socket=True)
    assert allows(LOCKED, token, host="robot:8420", origin="http://robot:8420", is_socket=True)


def test_websocket_without_an_origin_is_refused():
    assert not allows(OPEN, host=HERE, is_socket=True)


def test_token_is_taken_from_the_address_or_the_cookie():
    token = LOCKED.token
    assert allows(LOCKED, f"token={token}", host="robot:8420")
    assert allows(LOCKED, host="robot:8420", cookie=f"other=1; {LOCKED.cookie}={token}")
    assert LOCKED.brings_token(f"token={token}") and not LOCKED.brings_token("")


@pytest.mark.parametrize("other", ['prefs={"theme":"dark"}', "a b=1", "=", f"{LOCKED.cookie}=old", '"; "', "\xfc=1"])
def test_token_in_the_cookie_is_found_beside_cookies_of_other_programs(other):
    own = f"{LOCKED.cookie}={LOCKED.token}"
    assert allows(LOCKED, host="robot:8420", cookie=f"{other}; {own}")
    assert allows(LOCKED, host="robot:8420", cookie=f"{own};{other}")
    assert not allows(LOCKED, host="robot:8420", cookie=other)


@pytest.mark.parametrize("query", ["", "token=", "token=wrong", "token=\xfc", "Token=x", "token"])
def test_request_without_the_token_is_refused(query):
    assert not allows(LOCKED, query, host="robot:8420")
    assert not allows(LOCKED, query, host=HERE)  # also from this machine
    assert not allows(LOCKED, host="robot:8420", cookie=f"{LOCKED.cookie}={query}; =;")
    assert not LOCKED.brings_token(query)
    assert not OPEN.brings_token(query)
