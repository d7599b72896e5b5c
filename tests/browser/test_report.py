"""The report of an evaluation in a browser: it plays, moves, fits and follows the theme."""

import time

import pytest

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The address of the report of an agent that ships."""
    from latentplan.commands.main import main

    path = tmp_path_factory.mktemp("report") / "report.html"
    words = ["eval", "--checkpoint", "checkpoints/cartpole-swingup", "--device", "cpu", "--episodes", "1"]
    assert main([*words, "--report", str(path)]) == 0
    return path.as_uri()


def wait_until(is_true, seconds=60.0):
    end = time.monotonic() + seconds
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_film_of_the_report_plays(open_page, report):
    page = open_page(report)
    assert page.evaluate("document.querySelector('video').play().then(() => true)")
    wait_until(lambda: page.evaluate("document.querySelector('video').currentTime") > 0.5)
    assert page.evaluate("document.querySelector('video').videoWidth") > 500


def test_scrubber_of_the_report_shows_another_iteration(open_page, report):
    page = open_page(report)
    box = page.locator(".scrub").first
    slider, shown = box.locator("input[type=range]"), box.locator("output")
    frames = box.locator(":scope > .frame")
    num = frames.count()
    assert num >= 2 and shown.text_content() == f"{num} of {num}"  # the last one is shown first
    slider.focus()
    page.keyboard.press("Home")
    assert shown.text_content() == f"1 of {num}"
    assert frames.nth(0).is_visible() and not frames.nth(num - 1).is_visible()
    page.keyboard.press("ArrowRight")
    assert shown.text_content() == f"2 of {num}" and frames.nth(1).is_visible()


@pytest.mark.parametrize("width", [400, 1400])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_report_fits_the_window_in_both_themes(open_page, report, width, theme):
    page = open_page(report, width, theme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    before = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.locator("#theme").click()
    after = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert {before, after} == {"rgb(255, 255, 255)", "rgb(20, 23, 28)"}
    assert (before == "rgb(255, 255, 255)") == (theme == "light")
