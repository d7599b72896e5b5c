"""The loop of the live view: requests of the pages, one decision, messages to the pages, and the rest of the period."""

from __future__ import annotations

from latentplan.config import UserError
from latentplan.view.hub import Hub, Page
from latentplan.view.messages import (
    describe_future,
    describe_moment,
    describe_picture,
    describe_settings,
    obey,
    write,
)
from latentplan.view.pace import Pace
from latentplan.view.server import ViewServer
from latentplan.view.session import Session

FUTURES_PER_S = 4.0  # imagining takes longer than a decision
CHECK_S = 0.5


def run_live(session: Session, server: ViewServer, control_hz: float) -> None:
    """Runs the session while a page is open, until an interrupt.

    Args:
        session: The session; only this thread may use it.
        server: The server, which has been started.
        control_hz: Decisions per second of the wall clock.

    Raises:
        RuntimeError: The server has ended by itself.
    """
    pace, every = Pace(1.0 / control_hz), max(1, round(control_hz / FUTURES_PER_S))
    while server.is_alive:
        if not server.hub.wait_for_page(0.0):
            server.hub.wait_for_page(CHECK_S)
            pace.restart()
            continue
        step(session, server.hub, pace, looks_ahead=pace.num_decisions % every == 0)
        pace.finish()
    raise RuntimeError("the server of the live view has ended")


def step(session: Session, hub: Hub, pace: Pace, *, looks_ahead: bool) -> None:
    """Answers the requests that wait, makes one decision and publishes it.

    Args:
        session: The session.
        hub: The pages.
        pace: The pace, which is published too.
        looks_ahead: Whether the model imagines the future at this decision.
    """
    for page, text in hub.take_requests():
        _answer(session, hub, page, text)
    moment = session.decide(looks_ahead)
    hub.publish("moment", write(describe_moment(moment, pace)))
    if moment.future is not None:
        hub.publish("future", write(describe_future(moment, moment.future, pace)))


def _answer(session: Session, hub: Hub, page: Page, text: str) -> None:
    """Follows a request, and tells all pages what changed or the page itself why nothing did."""
    if not text:
        page.post("settings", write(describe_settings(session)))
        for name, content in session.pictures.contents.items():
            page.post("picture", write(describe_picture(name, content)))
        return
    try:
        answers = obey(session, text)
    except UserError as error:
        page.post("refused", write({"refused": str(error)}))
        return
    for answer in answers:
        hub.publish(next(iter(answer)), write(answer))
