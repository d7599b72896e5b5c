"""`benchmark.py search`: the cost that planners of this and other libraries reach in closed loop.

Every planner plays the same starts in the true dynamics of a problem: first with the same number of evaluated sequences
per decision, then with as many iterations as fit into the same milliseconds (of processor time with one thread, which
is the default; of time on the clock with more). This library's planners run with their defaults. Of other planners, the
settings with the lowest cost on starts that are not reported are taken for each problem.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, median, stdev
from typing import TYPE_CHECKING, Any

from bench.options import ComputeRequest, compute_on_processor
from bench.peers.install import (
    FOLDER,
    PEERS,
    PeerError,
    choose_peers,
    install,
    installed_version,
    left_out_on_error,
)
from bench.report import format_interval, format_number, format_table, write_json
from latentplan import __version__
from latentplan.config import UserError
from latentplan.config.checks import above_zero, at_least
from latentplan.config.parsing import option, raise_unknown, require_known

if TYPE_CHECKING:
    from bench.peers.client import JsonProcess

OURS = "latentplan"
PROBLEM_NAMES = ("pendulum", "navigation", "lq", "push", "humanoid", "latent")
BUDGETS = ("evaluations", "milliseconds")
FIRST_TUNING_SEED = 100  # reported are seeds from 0 on
WARM_UP = 3  # decisions before the timed ones
TOLERANCE = 1.1  # a decision may take this many times the budget, because times vary


@dataclass(frozen=True, kw_only=True)
class Request(ComputeRequest):
    """Flags of `benchmark.py search`.

    Attributes:
        problems: Control problems; `pendulum`, `navigation`, `lq`, `push`, `humanoid` and `latent`.
        planners: Planners of this library, by the name of `make_planner`; `all`, or `none`.
        peers: Other libraries, or `none`; each is installed on first use, in a Python environment apart from this one.
        seeds: Number of starts, of seeds 0, 1, 2 and so on; every planner plays all of them.
        tuning_seeds: Number of starts, of seeds 100, 101 and so on, on which settings of other planners are chosen.
        budgets: What is the same for every planner: `evaluations`, `milliseconds`, or both, one after the other.
        samples: Candidates per iteration.
        iterations: Iterations per decision at equal evaluations.
        budget_ms: Milliseconds per decision at equal time; None takes those of the results of `earlier`, or else those
            of this library's first planner at equal evaluations.
        timed: Decisions of each planner that are timed, in turns.
        jobs: Libraries that play at once; decisions are always timed alone.
        earlier: Results of earlier calls with other planners or libraries, whose rows join the tables and the result.
        json: Result as JSON.
    """

    problems: tuple[str, ...] = option(PROBLEM_NAMES, separator=",")
    planners: tuple[str, ...] = option(("all",), separator=",")
    peers: tuple[str, ...] = option(tuple(PEERS), separator=",")
    seeds: int = 10
    tuning_seeds: int = 3
    budgets: tuple[str, ...] = option(BUDGETS, separator=",")
    samples: int = 100
    iterations: int = 3
    budget_ms: float | None = None
    timed: int = 20
    jobs: int = 1
    earlier: tuple[Path, ...] = option((), metavar="FILE,FILE", separator=",")
    json: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        compute_on_processor(self)
        at_least(self, seeds=2, tuning_seeds=1, samples=2, iterations=1, timed=1, jobs=1)
        above_zero(self, "budget_ms")
        require_known("problem", self.problems, PROBLEM_NAMES)
        require_known("budget", self.budgets, BUDGETS)
        choose_peers(self.peers)
        has_budget = self.budget_ms is not None or self.earlier or "milliseconds" not in self.budgets
        if self.planners == ("none",) and not has_budget:
            raise UserError("--planners none has no milliseconds to compare with: give --budget-ms or --earlier")

    def compared(self) -> dict[str, Any]:
        """The settings that must be the same in results that are compared."""
        names = ("samples", "iterations", "seeds", "tuning_seeds")
        return {name: getattr(self, name) for name in names} | {
            "threads": self.threads or 1,
            "budgets": [name for name in BUDGETS if name in self.budgets],
            "budget_ms": self.budget_ms,
        }


@dataclass
class Arm:
    """A planner on a problem.

    Attributes:
        library: Name of the library.
        planner: Name of the planner within it.
        problem: Name of the problem.
        process: The process of the library.
        choices: Settings to choose from.
        settings: The chosen settings.
        tuning_cost: Mean cost of the chosen settings on the tuning seeds.
    """

    library: str
    planner: str
    problem: str
    process: JsonProcess
    choices: list[dict[str, Any]]
    settings: dict[str, Any] = field(default_factory=dict)
    tuning_cost: float = math.inf

    @property
    def title(self) -> str:
        """Library, planner and problem."""
        return f"{self.library} {self.planner} on {self.problem}"

    def ask(self, do: str, iterations: int, request: Request, **given: Any) -> dict[str, Any]:
        """The answer of the library's process.

        Raises:
            PeerError: The planner failed.
        """
        facts = {"do": do, "planner": self.planner, "problem": self.problem, "settings": self.settings, **given}
        answer = self.process.ask({**facts, "samples": request.samples, "iterations": iterations})
        if "error" in answer:
            raise PeerError(answer["error"])
        return answer

    def choose(self, request: Request) -> None:
        """Takes the settings with the lowest cost on the tuning seeds.

        Raises:
            PeerError: The planner failed, or no settings have a finite cost.
        """
        seeds = range(FIRST_TUNING_SEED, FIRST_TUNING_SEED + request.tuning_seeds)
        costs = []
        for settings in self.choices:
            self.settings = settings
            cost = fmean(self.ask("run", request.iterations, request, seeds=list(seeds))["costs"])
            costs.append(cost if math.isfinite(cost) else math.inf)
        self.tuning_cost = min(costs)
        if not math.isfinite(self.tuning_cost):
            raise PeerError("no settings have a finite cost on the starts for tuning")
        self.settings = self.choices[costs.index(self.tuning_cost)]

    def play(self, iterations: int, request: Request) -> dict[str, Any]:
        """Costs and evaluations on the starts that are reported.

        Raises:
            PeerError: The planner failed, or a cost is not finite.
        """
        answer = self.ask("run", iterations, request, seeds=list(range(request.seeds)))
        if not all(map(math.isfinite, answer["costs"])):
            raise PeerError(f"its cost is not finite on a reported start, with {iterations} iterations")
        return answer


def run(request: Request) -> int:
    """Plays every problem with every planner; prints a table and writes the result after each problem."""
    earlier = [row for path in request.earlier for row in read_rows(path, request)]
    budgets_ms = {problem: find_budget_ms(request, earlier, problem) for problem in request.problems}
    request.use_device(1)
    import torch

    from bench.machine import describe_machine

    rows: list[dict[str, Any]] = []
    best: list[dict[str, Any]] = []
    left_out: dict[str, str] = {}
    with ExitStack() as stack:
        libraries = start_libraries(request, stack, left_out)
        others = [name for name in libraries if name != OURS]
        facts = {
            "versions": {OURS: __version__, **{name: installed_version(name, FOLDER) for name in others}},
            "settings": request.compared(),
            "machine": describe_machine(torch.device("cpu")),
        }
        listed = {name: process.ask({"do": "list"})["planners"] for name, process in libraries.items()}
        listed[OURS] = select_planners(request, listed[OURS])
        for problem in request.problems:
            arms = [
                Arm(library, planner, problem, libraries[library], choices)
                for library, planners in listed.items()
                for planner, choices in planners.items()
            ]
            found = compare(arms, request, budgets_ms[problem], left_out)
            found += [row for row in earlier if row["problem"] == problem]
            rows += found
            print(f"\n{problem}, {request.seeds} seeds\n{cost_table(found)}", flush=True)
            best += compare_best(rows, problem)
            write_json(request.json, {"rows": rows, "best": best, "left_out": left_out, **facts})
    print("\n" + best_table(best))
    return 0


def start_libraries(request: Request, stack: ExitStack, left_out: dict[str, str]) -> dict[str, JsonProcess]:
    """The process of each library that can take part; the reason is printed for each that cannot.

    Raises:
        UserError: A planner of this library is unknown.
    """
    from bench.peers.client import JsonProcess

    FOLDER.parent.mkdir(parents=True, exist_ok=True)
    threads = str(request.threads or 1)
    own = ["-m", "bench.controllers.own", threads]
    libraries = {OURS: JsonProcess(Path(sys.executable), own, FOLDER.parent / f"{OURS}.log")}
    stack.callback(libraries[OURS].close)
    select_planners(request, libraries[OURS].ask({"do": "list"})["planners"])  # before others are installed
    for name in choose_peers(request.peers):
        with left_out_on_error(name, left_out):
            python = install(name, FOLDER)
            process = JsonProcess(python, ["-m", PEERS[name].controllers, threads], FOLDER / f"{name}.search.log")
            stack.callback(process.close)
            process.ask({"do": "list"})
            libraries[name] = process
    return libraries


def read_rows(path: Path, request: Request) -> list[dict[str, Any]]:
    """The rows of an earlier result.

    Raises:
        UserError: The file holds no result with the same settings.
    """
    try:
        result = json.loads(path.read_text())
        rows: list[dict[str, Any]] = result["rows"]
        had = dict(result["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"--earlier {path}: no result of this benchmark: {error!r}") from None
    now = request.compared()
    differences = [f"{name} {had.get(name)}, this call {now[name]}" for name in now if had.get(name) != now[name]]
    if differences:
        raise UserError(f"--earlier {path} was measured with other settings: {'; '.join(differences)}")
    return rows


def select_planners(request: Request, known: dict[str, Any]) -> dict[str, Any]:
    """This library's planners that take part.

    Raises:
        UserError: A planner is unknown.
    """
    if request.planners in (("all",), ("none",)):
        return known if request.planners == ("all",) else {}
    for name in request.planners:
        if name not in known:
            raise_unknown("planner", name, [*known, "all", "none"])
    return {name: known[name] for name in request.planners}


def find_budget_ms(request: Request, earlier: Sequence[dict[str, Any]], problem: str) -> float | None:
    """Milliseconds of a decision on a problem: those given, or those of earlier results; None where there are none.

    Raises:
        UserError: Earlier results were measured with different milliseconds, or do not note them.
    """
    if request.budget_ms is not None:
        return request.budget_ms
    timed = [row for row in earlier if row["problem"] == problem and row["budget"] == "milliseconds"]
    found = {row.get("budget_ms") for row in timed}
    if None in found:
        raise UserError("--earlier names a result of a version that did not note its milliseconds: measure it again")
    if len(found) > 1:
        raise UserError(f"--earlier names results with different milliseconds on {problem}: give --budget-ms to each")
    return found.pop() if found else None


def compare(
    arms: Sequence[Arm], request: Request, budget_ms: float | None, left_out: dict[str, str]
) -> list[dict[str, Any]]:
    """The rows of one problem: each planner at equal evaluations, then at equal milliseconds.

    Args:
        arms: The planners.
        request: The flags.
        budget_ms: Milliseconds of a decision; None takes those of the first planner of this library that is left.
        left_out: Receives the reason of an arm that fails.
    """

    def each(task: Callable[[Arm], Any], among: Sequence[Arm]) -> dict[int, Any]:
        """Results of a task by the arm's identity; libraries work at once, the arms of a library one by one."""
        results: dict[int, Any] = {}

        def do_library(library: str) -> None:
            for arm in [arm for arm in among if arm.library == library]:
                with left_out_on_error(arm.title, left_out):
                    results[id(arm)] = task(arm)

        with ThreadPoolExecutor(request.jobs) as pool:
            list(pool.map(do_library, dict.fromkeys(arm.library for arm in among)))
        return results

    def play(counts: dict[int, int], among: Sequence[Arm]) -> dict[int, Any]:
        return each(lambda arm: arm.play(counts[id(arm)], request), among)

    each(lambda arm: arm.choose(request), arms)
    arms = [arm for arm in arms if arm.title not in left_out]
    base = {id(arm): request.iterations for arm in arms}
    equal = play(base, arms)
    times = take_turns([arm for arm in arms if id(arm) in equal], base, request, left_out)
    arms = [arm for arm in arms if id(arm) in times]
    rows = [make_row("evaluations", arm, equal, base, times) for arm in arms]
    if "milliseconds" not in request.budgets:
        return rows
    if budget_ms is None:
        budget_ms = next((times[id(arm)] for arm in arms if arm.library == OURS), None)
    if budget_ms is None:
        print("no planner of this library is left, whose milliseconds the others would get", flush=True)
        return rows if "evaluations" in request.budgets else []
    counts = fit_counts(arms, budget_ms, times, request, left_out)
    timely = {key: equal[key] for key, count in counts.items() if count == request.iterations}
    timely |= play(counts, [arm for arm in arms if id(arm) in counts and id(arm) not in timely])
    times = take_turns([arm for arm in arms if id(arm) in timely], counts, request, left_out)
    rows = rows if "evaluations" in request.budgets else []
    return rows + [make_row("milliseconds", arm, timely, counts, times, budget_ms) for arm in arms if id(arm) in times]


def fit_counts(
    arms: Sequence[Arm], budget_ms: float, times: dict[int, float], request: Request, left_out: dict[str, str]
) -> dict[int, int]:
    """The number of iterations of each arm that fits into a time; measured, and corrected once.

    Args:
        arms: The arms; one that fails has no number.
        budget_ms: Milliseconds of a decision.
        times: Milliseconds of a decision with `request.iterations`, by the arm's identity.
        request: The flags.
        left_out: Receives the reason of an arm that fails.
    """
    single = take_turns(arms, {id(arm): 1 for arm in arms}, request, left_out)
    counts = {key: request.iterations for key in single}
    for _ in range(2):
        counts = {key: fit_iterations(budget_ms, single[key], times[key], counts[key]) for key in counts}
        arms = [arm for arm in arms if id(arm) in counts]
        times = take_turns(arms, counts, request, left_out)
        counts = {key: counts[key] for key in times}
    return counts


def fit_iterations(budget_ms: float, one_ms: float, all_ms: float, iterations: int) -> int:
    """The largest number of iterations that fits into a time, up to `TOLERANCE`, at least 1.

    Args:
        budget_ms: The time.
        one_ms: Milliseconds of a decision with one iteration.
        all_ms: Milliseconds of a decision with `iterations`.
        iterations: A number of iterations; with 1, time is taken as proportional.
    """
    each_ms = (all_ms - one_ms) / (iterations - 1) if iterations > 1 else one_ms
    if each_ms <= 0.0:
        return iterations
    return max(1, int((TOLERANCE * budget_ms - one_ms) / each_ms + 1.0))


def take_turns(
    arms: Sequence[Arm], counts: dict[int, int], request: Request, left_out: dict[str, str]
) -> dict[int, float]:
    """Median milliseconds of a decision of each arm, timed in turns so that a busy machine slows down all of them.

    An arm that fails has no time.
    """
    laps: dict[int, list[float]] = {id(arm): [] for arm in arms}
    for _ in range(WARM_UP + request.timed):
        for arm in arms:
            if arm.title in left_out:
                continue
            with left_out_on_error(arm.title, left_out):
                laps[id(arm)].append(arm.ask("time", counts[id(arm)], request)["ms"])
    return {id(arm): median(laps[id(arm)][WARM_UP:]) for arm in arms if arm.title not in left_out}


def make_row(
    budget: str,
    arm: Arm,
    played: dict[int, Any],
    counts: dict[int, int],
    times: dict[int, float],
    budget_ms: float | None = None,
) -> dict[str, Any]:
    """One row of the result; `budget_ms` is the milliseconds that all planners got, None at equal evaluations."""
    costs = played[id(arm)]["costs"]
    return {
        "problem": arm.problem,
        "planner": arm.planner,
        "library": arm.library,
        "budget": budget,
        "budget_ms": budget_ms,
        "cost_mean": fmean(costs),
        "cost_sd": stdev(costs),
        "evaluations": played[id(arm)]["evaluations"],
        "ms_p50": times[id(arm)],
        "iterations": counts[id(arm)],
        "settings": arm.settings,
        "tuning_cost": arm.tuning_cost,
        "costs": costs,
    }


def compare_best(rows: Sequence[dict[str, Any]], problem: str) -> Iterator[dict[str, Any]]:
    """Of each budget, the best planner of this and of other libraries, and the difference, paired over the seeds.

    The best planners are those with the lowest cost on the tuning seeds at equal evaluations.
    """
    from latentplan.evaluation.statistics import confidence_interval

    for budget in BUDGETS:
        here = [row for row in rows if row["problem"] == problem and row["budget"] == budget]
        own = [row for row in here if row["library"] == OURS]
        peers = [row for row in here if row["library"] != OURS]
        if own and peers:
            ours, peer = (min(side, key=lambda row: row["tuning_cost"]) for side in (own, peers))
            differences = [left - right for left, right in zip(ours["costs"], peer["costs"], strict=True)]
            yield {
                "problem": problem,
                "budget": budget,
                "ours": ours["planner"],
                "ours_cost": ours["cost_mean"],
                "peer": f"{peer['library']} {peer['planner']}",
                "peer_cost": peer["cost_mean"],
                "difference": fmean(differences),
                "ci95": list(confidence_interval(differences)),
            }


def cost_table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows of one problem as a text table: a line for each planner, both budgets side by side."""
    planners: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        planners.setdefault((row["library"], row["planner"]), {})[row["budget"]] = row
    lines = [
        [" ".join(name), *(cell for budget in BUDGETS for cell in _cells(found.get(budget)))]
        for name, found in planners.items()
    ]
    columns = ["cost", "sd", "sequences", "ms p50"]
    return format_table(["planner", *columns, *(f"{name}, equal ms" for name in columns)], lines)


def best_table(best: Sequence[dict[str, Any]]) -> str:
    """The best planners of both sides as a text table; empty without other libraries."""
    if not best:
        return "no other library took part"
    lines = [
        [f"{row['problem']}, equal {row['budget']}", row["ours"], format_number(row["ours_cost"], 2), row["peer"]]
        + [format_number(row["peer_cost"], 2), format_number(row["difference"], 2, sign=True)]
        + [format_interval(row["ci95"], 2, sign=True)]
        for row in best
    ]
    return format_table(["problem", "best of ours", "cost", "best other", "cost", "difference", "95 %"], lines)


def _cells(row: dict[str, Any] | None) -> list[str]:
    digits = {"cost_mean": 2, "cost_sd": 2, "evaluations": 0, "ms_p50": 1}
    return [format_number(row[key] if row else None, number) for key, number in digits.items()]
