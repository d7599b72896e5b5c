"""The server over a real socket: its files, its refusals, and messages in both directions."""

import http.client
import json
import re
import time

import pytest
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect

from latentplan.config import UserError
from latentplan.view.access import listen
from latentplan.view.loop import step
from latentplan.view.pace import Pace
from latentplan.view.server import ViewServer


@pytest.fixture(scope="module")
def server():
    """A view on the loopback interface."""
    started = ViewServer(listen("127.0.0.1", 0), "a <view>")
    started.start()
    yield started
    started.stop()
    assert not started.is_alive


@pytest.fixture(scope="module")
def locked():
    """A view on all interfaces, which has a token."""
    started = ViewServer(listen("0.0.0.0", 0), "a view")
    started.start()
    yield started
    started.stop()


def get(server, path="/", **headers):
    """The response to a request, and its text."""
    connection = http.client.HTTPConnection("127.0.0.1", server.access.port, timeout=10)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    text = response.read().decode()
    connection.close()
    return response, text


def open_socket(server, origin=None, **options):
    port = server.access.port
    return connect(f"ws://127.0.0.1:{port}/live", origin=origin or f"http://127.0.0.1:{port}", **options)


def receive(socket, kind, tries=50):
    """The next message of a kind."""
    for _ in range(tries):
        message = json.loads(socket.recv(timeout=10))
        if kind in message:
            return message[kind]
    raise AssertionError(f"no {kind} among {tries} messages")


def test_page_names_only_files_that_the_server_has(server):
    response, text = get(server)
    assert response.status == 200 and "a &lt;view&gt;" in text
    names = re.findall(r'(?:src|href)="([^":]+)"', text)
    assert len(names) == 5
    for name in names:
        response, content = get(server, f"/{name}")
        assert response.status == 200 and content
    assert get(server, "/session.py")[0].status == get(server, "/../pyproject.toml")[0].status == 404


def test_page_may_load_nothing_from_elsewhere(server):
    policy = get(server)[0].headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "http" not in policy


def test_request_for_another_name_is_refused(server):
    assert get(server, Host="evil.example")[0].status == 403
    assert get(server, Host=f"localhost:{server.access.port}")[0].status == 200


def test_websocket_of_another_website_is_refused(server):
    with pytest.raises(InvalidStatus) as error, open_socket(server, origin="http://evil.example"):
        pass
    assert error.value.response.status_code == 403


def test_view_on_all_interfaces_needs_its_token(locked):
    token = locked.access.token
    assert locked.url.endswith(f":{locked.access.port}/?token={token}")
    for path in ("/", "/live.js", "/?token=wrong"):
        response, text = get(locked, path)
        assert response.status == 403 and token not in text
    with pytest.raises(InvalidStatus) as error, open_socket(locked):
        pass
    assert error.value.response.status_code == 403


def test_token_of_the_address_becomes_a_cookie(locked):
    response, _ = get(locked, f"/?token={locked.access.token}")
    assert response.status == 303 and response.headers["Location"] == "/"
    cookie = response.headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=lax" in cookie
    kept = {"Cookie": cookie.partition(";")[0]}
    assert get(locked, **kept)[0].status == get(locked, "/live.js", **kept)[0].status == 200
    with open_socket(locked, additional_headers=kept):
        pass


def test_page_gets_settings_and_moments_and_changes_the_session(server, session):
    pace = Pace(0.04)
    with open_socket(server) as socket:
        assert server.hub.wait_for_page(10)
        step(session, server.hub, pace, looks_ahead=True)
        assert receive(socket, "settings")["mode"] == "planner"
        socket.send(json.dumps({"horizon": "2", "objective": "cart -> 0.8"}))
        wait_for_request(server)
        step(session, server.hub, pace, looks_ahead=True)
        assert receive(socket, "settings")["objective"] == "cart -> 0.8"
        assert receive(socket, "future")["num_steps"] == 2
        assert receive_moment(session, server, pace, socket)["clauses"][0][0] == "cart -> 0.8"
        assert session.agent.controller.planner.horizon == 2


def test_bad_request_is_refused_to_its_page_and_the_session_goes_on(server, session):
    pace = Pace(0.04)
    with open_socket(server) as socket, open_socket(server) as other:
        socket.send(json.dumps({"objective": "cart -> <b>"}))
        wait_for_request(server, 3)
        step(session, server.hub, pace, looks_ahead=False)
        assert "<b>" in receive(socket, "refused")
        assert receive(socket, "moment")["decision"] == 0 == receive(other, "moment")["decision"]
        assert session.settings.objective is None


def test_message_that_is_too_large_closes_the_page_alone(server, session):
    with open_socket(server) as other:
        with open_socket(server) as socket:
            socket.send("x" * 10_000_000)
            with pytest.raises(Exception, match="1009|too big|no close frame|closed"):
                receive(socket, "moment")
        step(session, server.hub, Pace(0.04), looks_ahead=False)
        assert receive(other, "moment")["decision"] == 0


def test_message_of_bytes_closes_the_page_alone(server, session):
    with open_socket(server) as other, open_socket(server) as socket:
        socket.send(b"abc")
        with pytest.raises(ConnectionClosedError, match="1003"):
            receive(socket, "moment")
        step(session, server.hub, Pace(0.04), looks_ahead=False)
        assert receive(other, "moment")["decision"] == 0


def test_slow_page_gets_the_newest_moment(server, session):
    pace = Pace(0.04)
    with open_socket(server) as socket:
        wait_for_request(server)
        for _ in range(5):
            step(session, server.hub, pace, looks_ahead=False)
            pace.num_decisions += 1
        numbers = [receive(socket, "moment")["number"]]
        while numbers[-1] < 4:
            numbers.append(receive(socket, "moment")["number"])
        assert numbers == sorted(set(numbers))


def test_no_page_is_open_after_the_last_one_was_closed(server):
    with open_socket(server):
        assert server.hub.wait_for_page(10)
    end = time.monotonic() + 10
    while server.hub.wait_for_page(0.0) and time.monotonic() < end:
        time.sleep(0.01)
    assert not server.hub.wait_for_page(0.0)


def test_port_in_use_is_refused_in_one_line(server):
    with pytest.raises(UserError, match=r"--port \d+ cannot be used: Address already in use"):
        listen("127.0.0.1", server.access.port)


@pytest.mark.parametrize("host", ["999.1.1.1", "no such host", "a" * 1000, "\0", "::ffff:1.2.3.4"])
def test_address_that_is_not_of_this_machine_is_refused_in_one_line(host):
    with pytest.raises(UserError, match="cannot be used") as error:
        listen(host, 0)
    assert "\n" not in str(error.value) and len(str(error.value)) < 300


def wait_for_request(server, num=1):
    """Waits until requests have reached the hub."""
    end = time.monotonic() + 10
    while server.hub.requests.qsize() < num:
        assert time.monotonic() < end
        time.sleep(0.005)


def receive_moment(session, server, pace, socket):
    """The moment of one more decision."""
    step(session, server.hub, pace, looks_ahead=False)
    while (moment := receive(socket, "moment"))["decision"] < session._decision - 1:
        pass
    return moment
