"""The live view in a browser, with the walker that ships: what the controls ask for changes what the body does."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.browser
ROOT = Path(__file__).resolve().parents[2]
STANDING = "abs(speed) < 0.2 and height > 1.2"
WINDOW = 20  # decisions, one second of the walker


@pytest.fixture(scope="module")
def address():
    """The address of a live view of the walker, which Ctrl-C ends with the exit code 130."""
    words = ["--checkpoint", "checkpoints/walker-walk", "--device", "cpu", "--port", "0"]
    command = [sys.executable, "-m", "latentplan", "view", *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            lines = [process.stdout.readline() for _ in range(2)]
            yield re.search(r"http://\S+", lines[1])[0]
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 130


class Live:
    """What a page of the live view shows."""

    def __init__(self, page):
        self.page = page
        page.wait_for_selector("#latency .main-svg >> nth=0")

    def state(self):
        return self.page.locator("#state").text_content()

    def place(self):
        """Numbers of the episode and of the decision in it."""
        return tuple(map(int, re.search(r"episode (\d+), decision (\d+)", self.state()).groups()))

    def quantity(self, name):
        row = self.page.locator("#quantities tbody tr", has_text=name).first
        return float(row.locator("td").nth(1).text_content())

    def mean_speed(self):
        """Mean speed over a second of simulated time, in m/s."""
        values, last = [], None
        while len(values) < WINDOW:
            if (place := self.place()) != last:
                values.append(self.quantity("speed"))
                last = place
            time.sleep(0.01)
        return float(np.mean(values))

    def pursue(self, objective):
        self.page.locator("#objective").fill(objective)
        self.page.locator("#apply").click()


@pytest.fixture
def live(open_page, address):
    shown = Live(open_page(address))
    yield shown
    shown.page.locator("#task").click()


def wait_until(is_true, seconds=300.0):
    end = time.monotonic() + seconds
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_page_follows_the_simulation(live):
    first, camera = live.place(), live.page.locator("#camera").get_attribute("src")
    wait_until(lambda: live.place()[1] >= first[1] + 10 or live.place()[0] > first[0])
    assert live.page.locator("#camera").get_attribute("src") != camera
    assert "steps of 50 ms ahead" in live.page.locator("#imagined-text").text_content()
    for chart in ("fan-0", "fan-1", "surprise", "latency"):
        assert live.page.locator(f"#{chart} .scatterlayer .js-line").count() > 0


def test_changed_objective_changes_what_the_body_does(live):
    wait_until(lambda: live.mean_speed() > 0.7)  # it walks
    live.pursue(STANDING)
    wait_until(lambda: abs(live.mean_speed()) < 0.35 and live.quantity("height") > 1.0)  # it stands
    assert live.page.locator("#clauses tbody tr").count() == 3  # two clauses and the score
    live.page.locator("#task").click()
    wait_until(lambda: live.mean_speed() > 0.7)  # it walks again


def test_bad_objective_is_answered_by_one_line_and_the_body_goes_on(live):
    live.pursue("sped -> 2.0")
    refusal = live.page.locator("#refusal")
    wait_until(refusal.is_visible)
    assert "'speed'" in refusal.text_content()
    before = live.place()
    wait_until(lambda: live.place() != before)
    assert live.page.locator("#clauses").is_hidden()


def test_push_and_next_episode_act_on_the_body(live):
    live.page.locator("#push-right").click()
    wait_until(lambda: "pushed" in live.state())
    wait_until(lambda: "pushed" not in live.state())
    episode = live.place()[0]
    live.page.locator("#reset").click()
    wait_until(lambda: live.place()[0] == episode + 1)


def test_settings_are_those_of_the_program_in_every_page(live, open_page, address):
    live.page.locator("#horizon").fill("3")
    live.page.keyboard.press("Tab")
    live.page.locator("#mode").select_option("gated")
    wait_until(lambda: "1, 2, 3 steps" in live.page.locator("#imagined-text").text_content())
    other = Live(open_page(address))
    assert other.page.locator("#horizon").input_value() == "3"
    assert other.page.locator("#mode").input_value() == "gated"
    live.page.locator("#horizon").fill("")
    live.page.keyboard.press("Tab")
    live.page.locator("#mode").select_option("planner")
    wait_until(lambda: other.page.locator("#mode").input_value() == "planner")
    assert other.page.locator("#horizon").input_value() == ""


def test_controls_show_the_search_in_use_after_a_refusal(live):
    live.page.locator("#num_samples").fill("17")  # fewer than the actor's own candidates
    live.page.keyboard.press("Tab")
    refusal = live.page.locator("#refusal")
    wait_until(refusal.is_visible)
    assert "num_samples (17)" in refusal.text_content()
    assert live.page.locator("#num_samples").input_value() == ""


def test_picture_of_the_camera_becomes_a_goal(live):
    live.page.locator("#snapshot").click()
    live.page.locator("#gallery button").first.click()
    wait_until(lambda: "score" in live.page.locator("#clauses").text_content())
    assert live.page.locator("#objective").input_value() == "goal:picture-1.png"


@pytest.mark.parametrize("width", [400, 1400])
def test_live_view_fits_the_window(open_page, address, width):
    live = Live(open_page(address, width, "dark"))
    assert live.page.evaluate("document.documentElement.scrollWidth") <= width
    assert live.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 23, 28)"


def test_picture_that_is_too_large_is_refused_and_the_page_stays_connected(live):
    content = {"name": "large.png", "mimeType": "image/png", "buffer": bytes(5_000_000)}
    live.page.locator("#file").set_input_files(content)
    refusal = live.page.locator("#refusal")
    wait_until(refusal.is_visible)
    assert refusal.text_content() == "a goal picture must be a PNG file of at most 2 MB"
    before = live.place()
    wait_until(lambda: live.place() != before)
