"""`latentplan view`: show a trained agent at work in the browser, and change its goal and search meanwhile.

Torch, the simulator and the server are imported once the flags are checked, so that `--help` and bad input answer at
once.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from latentplan.commands.evaluate import check_env, check_expressions, list_modes, open_env
from latentplan.commands.flags import overrides
from latentplan.commands.shell import ComputeRequest, check_search, read_search, saved_config, search_settings
from latentplan.config import PlannerConfig
from latentplan.config.checks import above_zero, at_least, one_of, within
from latentplan.config.env_id import ENV_FLAGS, EnvChoice, choose_env
from latentplan.config.extras import require_extra
from latentplan.config.parsing import option

if TYPE_CHECKING:
    import socket

    from latentplan.config import EnvConfig

LARGEST_PORT = 65535


@dataclass(frozen=True, kw_only=True)
class Request(ComputeRequest):
    """The command line of a live view.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        mode: Agent that chooses the actions.
        objective: Objective in place of the task, such as 'speed -> 2.0 and height > 1.1'.
        constraint: Condition that must hold at every moment, such as 'cart < 0.5'; may be repeated.
        control_hz: Decisions per second of the wall clock, in [0.001, 1e6]; None takes the body's own rate.
        host: Address to listen at; another one than this machine's own needs the token that is printed.
        port: Port to listen at; 0 takes any free one.
        open: Whether the browser of this machine is opened.
        seed: Seed of the starts: episode i starts as that of an evaluation with the seed.
        env: The environment, in place of the one that the agent learned in.
        planner: Settings of the search, in place of the agent's own.
    """

    NOTES = (
        "The page can change mode, objective, constraint and search. The simulation waits while no page is open; "
        "Ctrl-C ends it. Planner defaults shown are the program's; the settings of a checkpoint hold unless given here."
    )

    checkpoint: Path = option(metavar="DIR")
    mode: str = option("planner", choices=lambda: list_modes())
    objective: str | None = None
    constraint: str | None = option(None, join="; ")
    control_hz: float | None = None
    host: str = "127.0.0.1"
    port: int = 8420
    open: bool = False
    seed: int = 0
    env: dict[str, Any] = overrides(EnvChoice, ENV_FLAGS, prefix="env.")
    planner: dict[str, Any] = overrides(PlannerConfig, prefix="planner.")

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, seed=0)
        one_of(self, mode=list_modes())
        above_zero(self, "control_hz")
        if self.control_hz is not None:
            within(self, control_hz=(0.001, 1e6))
        within(self, port=(0, LARGEST_PORT))


def resolve(request: Request) -> dict[str, Any]:
    """The fields of the request, with every setting of the search that the agent would use."""
    return {**vars(request), "planner": read_search(request.checkpoint, request.planner)}


def run(request: Request) -> int:
    """Serve the page until Ctrl-C, and return the exit code.

    Raises:
        UserError: The checkpoint, an objective, a setting or the address cannot be used.
        MissingExtra: The server's libraries are not installed.
    """
    require_extra("the live view", "starlette", "uvicorn", "websockets", "plotly")
    from latentplan.agents.info import read_info

    info = read_info(request.checkpoint)
    config = saved_config(request.checkpoint, info)
    chosen = choose_env(config.env, request.env)
    check_env(chosen)
    check_search(search_settings(config, request.planner), config.model)
    check_expressions(request.objective, request.constraint, chosen.domain)
    from latentplan.view.access import listen

    with contextlib.ExitStack() as stack:
        listening = stack.enter_context(listen(request.host, request.port))
        _serve(request, chosen, info, listening, stack)
    return 0


def _serve(
    request: Request, chosen: EnvConfig, info: dict[str, Any], listening: socket.socket, stack: contextlib.ExitStack
) -> None:
    """Make agent, environment and server, and run them until an interrupt; the stack closes them."""
    import tempfile
    import webbrowser

    from latentplan.agents.checkpoint import load_model
    from latentplan.envs.registry import describe_renderer
    from latentplan.evaluation.goals import goal_env
    from latentplan.planning import settle
    from latentplan.view.loop import run_live
    from latentplan.view.pictures import GoalPictures
    from latentplan.view.server import ViewServer
    from latentplan.view.session import Session, Settings, Trained

    name = f"{chosen.domain}-{chosen.task}"
    server = ViewServer(listening, f"{name}: live view")
    stack.callback(server.stop)
    device = request.use_device(threads=1)  # the other cores draw the page
    world = goal_env(chosen)
    env = open_env(world, info)
    stack.callback(env.close)
    pictures = GoalPictures(Path(stack.enter_context(tempfile.TemporaryDirectory())), request.objective)
    settings = Settings(request.mode, request.objective, request.constraint, request.planner)
    trained = Trained(*load_model(request.checkpoint, device))
    session = Session(env, chosen.domain, trained, settings, pictures, seed=request.seed)
    stack.callback(session.close)
    control_hz = request.control_hz or 1.0 / session.period_s
    session.warm_up()
    settle()
    server.start()
    print(f"{name}, {request.mode} on {device}, pictures by {describe_renderer(world)['renderer']}")
    print(f"{control_hz:g} decisions per second; Ctrl-C ends the live view at {server.url}", flush=True)
    if request.open:
        webbrowser.open(server.url)
    run_live(session, server, control_hz)
