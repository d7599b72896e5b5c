"""The report of a trained agent: one page with film, returns, curves, decision times, imagination and searches."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from latentplan import __version__
from latentplan.config import Config, to_dict
from latentplan.config.run_results import Evaluation
from latentplan.config.settings import by_key
from latentplan.reporting.compare import CLOCKS, OFFLINE_CLOCKS, published_rows
from latentplan.reporting.frame import Frame
from latentplan.reporting.page import Section, figure, film, picture, render_page, scrubber, table
from latentplan.reporting.published import published_returns_of
from latentplan.reporting.recorder import Inspection, Recording
from latentplan.reporting.svg import Labels, Line, plot_fan, plot_histogram, plot_lines

SEPARATOR = 128  # grey between pictures, visible on light and dark pictures
GAP = 1
SHOWN_DIMENSIONS = 2
NUM_BINS = 40


@dataclass(frozen=True)
class Returns:
    """Returns of one mode of acting.

    Attributes:
        mode: Name of the mode.
        returns: Return of each episode.
        interval: Ends of the 95 % interval of their mean; NaN for one episode.
    """

    mode: str
    returns: Sequence[float]
    interval: tuple[float, float]


@dataclass(frozen=True)
class ReportData:
    """What a report shows.

    Attributes:
        task: The task as domain-task.
        config: Settings of the agent.
        returns: Returns by mode.
        film: A film of one episode; None without one.
        evaluations: Evaluations during training.
        recording: What was recorded in one episode; None without.
        decision_ms: Milliseconds of each decision; empty where they were not measured.
        deadlines_ms: Deadlines of a decision, by their names.
        facts: Provenance by name: command, commit, versions, hardware and others.
    """

    task: str
    config: Config
    returns: Sequence[Returns] = ()
    film: Path | None = None
    evaluations: Sequence[Evaluation] = ()
    recording: Recording | None = None
    decision_ms: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    deadlines_ms: Mapping[str, float] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)


def render_report(data: ReportData) -> str:
    """The report as HTML; parts for which there are no figures are left out."""
    recording = data.recording or Recording()
    shown = [] if data.film is None else [figure(film(data.film, f"film of {data.task}"), "One episode.")]
    return render_page(
        f"{data.task}: report",
        [
            Section("Film", "Left: the camera. Right: the end of the plan, as the model imagines it.", shown),
            Section("Returns", "Sum of rewards per episode, with Student's 95 % interval of the mean.", _returns(data)),
            Section(
                "Training curves",
                "Mean returns of the evaluations during training, in env frames (before action repeat) and in minutes "
                "of wall clock. Published returns are means over seeds; dotted levels are the lowest and highest.",
                _training_curves(data),
            ),
            Section(
                "Decision time",
                "Milliseconds from a frame in memory to the action.",
                _decision_times(data),
            ),
            Section(
                "Imagined against real",
                "The model starts from the belief at one frame and sees no further frame: it gets only the actions "
                "that were executed. Upper rows are the camera, lower rows the imagination.",
                _imagination(recording),
            ),
            Section(
                "Searches",
                "At a few decisions: the candidates and elites of every iteration. Pictures are means over candidates "
                "(upper row) and over elites (lower row) of decoded states; where they blur, the sequences disagree.",
                [_search(each) for each in recording.inspections],
            ),
            Section(
                "Planner and actor",
                "What the agent did, and what the actor would have done at the same frame.",
                _planner_and_actor(recording),
            ),
            Section(
                "Surprise and gate",
                "Surprise is the distance of a frame from the model's prediction, in nats.",
                _surprise(recording),
            ),
            Section("Goals", "Objective and constraints of this evaluation, by true quantities.", _goals(recording)),
            Section("Provenance", "How this report can be made again.", _provenance(data)),
        ],
    )


def _returns(data: ReportData) -> list[str]:
    if not data.returns:
        return []
    rows = [["mode", "episodes", "mean return", "95 % interval", "lowest", "highest"]]
    lines = []
    for each in data.returns:
        low, high = each.interval
        interval = "one episode has none" if math.isnan(low) else f"{low:.1f} to {high:.1f}"
        ends = f"{min(each.returns):.1f}", f"{max(each.returns):.1f}"
        rows.append([each.mode, str(len(each.returns)), f"{np.mean(each.returns):.1f}", interval, *ends])
        lines.append(Line(each.mode, np.arange(1, len(each.returns) + 1), each.returns, style="o"))
    levels = [(f"mean, {each.mode}", float(np.mean(each.returns))) for each in data.returns]
    labels = Labels("Return of each episode", "episode", "return (sum of rewards)", levels=levels)
    return [table(rows), figure(plot_lines(lines, labels, whole_x=True), "Return of each episode.")]


def _training_curves(data: ReportData) -> list[str]:
    known = published_returns_of(data.task)
    parts = []
    if data.evaluations:
        last = data.evaluations[-1].env_frames
        levels = _published_levels(known, last)
        for clock, unit in (CLOCKS if last else OFFLINE_CLOCKS).items():
            times = [getattr(each, clock) for each in data.evaluations]
            lines = [
                Line(mode, times, [getattr(each, mode) for each in data.evaluations]) for mode in ("planner", "actor")
            ]
            labels = Labels(f"Evaluation return against {unit}", unit, "mean return", levels=levels)
            parts.append(figure(plot_lines(lines, labels, large_x=clock != "minutes"), labels.alt + "."))
    if known and parts:
        parts.append(table(published_rows(known), f"{data.task}: published mean returns by frames"))
    return parts


def _published_levels(known: Mapping[str, Mapping[int, float]], last: int) -> list[tuple[str, float]]:
    """The lowest and the highest published mean at the number of frames that is nearest to the last evaluation's."""
    frames = {at for means in known.values() for at in means}
    if not frames:
        return []
    at = min(frames, key=lambda each: abs(each - last))
    means = sorted((means[at], name) for name, means in known.items() if at in means)
    ends = dict.fromkeys([means[-1], means[0]])
    return [(f"{name}, {at // 1000:,}k frames", value) for value, name in ends]


def _decision_times(data: ReportData) -> list[str]:
    if not len(data.decision_ms):
        return []
    p50, p95, p99 = np.percentile(data.decision_ms, [50, 95, 99])
    marks = [(f"{name}, {value:g} ms", value) for name, value in data.deadlines_ms.items()]
    largest = max(float(p99) * 1.5, *(value * 1.05 for _, value in marks), 0.1)
    labels = Labels("Histogram of decision times", "decision time (ms)", "decisions", marks=marks)
    inside = np.minimum(data.decision_ms, largest)
    drawn = plot_histogram([("", inside)], labels, np.linspace(0.0, largest, NUM_BINS).tolist())
    rows = [["quantile", "milliseconds"]]
    rows += [["median", f"{p50:.2f}"], ["95 %", f"{p95:.2f}"], ["99 %", f"{p99:.2f}"]]
    for name, value in data.deadlines_ms.items():
        late = float(np.mean(data.decision_ms > value))
        rows.append([f"share later than the {name}", _percent(late)])
    return [figure(drawn, "Times beyond the right end are counted in the last bar."), table(rows)]


def _imagination(recording: Recording) -> list[str]:
    parts = []
    for strip in recording.strips:
        steps = ", ".join(map(str, strip.steps))
        caption = f"From decision {strip.decision}: {steps} steps ahead."
        grid = tile([strip.real, strip.imagined])
        parts.append(figure(picture(grid, f"Camera above imagination. {caption}"), caption))
    errors = (
        (recording.picture_error, "picture error (of 255)", "Mean absolute difference of pictures"),
        (recording.reward_error, "reward error (per decision)", "Mean absolute error of the predicted reward"),
    )
    for values, label, name in errors:
        if values.size:
            steps_ahead = np.arange(1, values.shape[1] + 1)
            low, high = np.percentile(values, [10, 90], axis=0)
            line = Line(f"mean of {len(values)} starts", steps_ahead, values.mean(axis=0), low, high)
            drawn = plot_lines([line], Labels(f"{name} by step", "steps ahead", label), whole_x=True)
            parts.append(figure(drawn, f"{name}; the band holds 80 % of the starts."))
    return parts


def _search(inspection: Inspection) -> str:
    """The iterations of a search, with a slider."""
    steps = ", ".join(map(str, inspection.shown_steps))
    frames = []
    for index, each in enumerate(inspection.search, start=1):
        pictures = tile([each.candidate_pictures, each.elite_pictures])
        alt = f"Iteration {index}: mean pictures over candidates and over elites, {steps} steps ahead"
        parts = [picture(pictures, alt)]
        for dimension in range(min(SHOWN_DIMENSIONS, each.mean.shape[1])):
            labels = Labels(
                f"Iteration {index}: action {dimension + 1} of candidates and elites",
                "step of the plan",
                f"action {dimension + 1} (-1 to 1)",
            )
            candidates, elites, mean = (rows[..., dimension] for rows in (each.candidates, each.elites, each.mean))
            parts.append(plot_fan(candidates, elites, mean, labels))
        parts.append(f"<p>Mean predicted return of the elites: {each.elite_return:.2f}.</p>")
        frames.append((f"{index} of {len(inspection.search)}", "".join(parts)))
    caption = (
        f"Decision {inspection.decision}; pictures are {steps} steps ahead. Lines are sequences of an action dimension."
    )
    return figure(scrubber("iteration", frames), caption)


def _planner_and_actor(recording: Recording) -> list[str]:
    if not recording.actor_actions or all(source == "actor" for source in recording.sources):
        return []
    parts = []
    taken, actor = np.stack(recording.actions), np.stack(recording.actor_actions)
    decisions = np.arange(len(taken))
    for dimension in range(min(SHOWN_DIMENSIONS, taken.shape[1])):
        lines = [
            Line("planner", decisions, taken[:, dimension]),
            Line("actor", decisions, actor[:, dimension]),
        ]
        name = f"action {dimension + 1}"
        labels = Labels(f"{name.capitalize()} of planner and actor", "decision", f"{name} (-1 to 1)")
        parts.append(figure(plot_lines(lines, labels), labels.alt + "."))
    distance = np.linalg.norm(taken - actor, axis=1)
    labels = Labels("Distance of the planner's action from the actor's", "decision", "distance of actions")
    parts.append(figure(plot_lines([Line("", decisions, distance)], labels), labels.alt + "."))
    for each in recording.inspections:
        steps = ", ".join(map(str, each.shown_steps))
        caption = (
            f"Decision {each.decision}: imagined along the plan (upper row, predicted reward {each.plan_reward:.2f}) "
            f"and along the actor (lower row, {each.actor_reward:.2f}), {steps} steps ahead."
        )
        parts.append(figure(picture(tile([each.plan_pictures, each.actor_pictures]), caption), caption))
    return parts


def _surprise(recording: Recording) -> list[str]:
    if not recording.surprise:
        return []
    decisions = np.arange(len(recording.surprise))
    values = np.array(recording.surprise)
    lines = [Line("surprise", decisions, values)]
    if recording.threshold:
        planned = [index for index, source in enumerate(recording.sources) if source == "plan"]
        lines.append(Line("planned", planned, values[planned], style="o"))
    levels = [] if recording.surprise_limit is None else [("surprise limit", recording.surprise_limit)]
    labels = Labels("Surprise over the episode", "decision", "surprise (nats)", levels=levels)
    parts = [figure(plot_lines(lines, labels), labels.alt + ".")]
    if recording.threshold:
        labels = Labels("Threshold of the gate", "decision", "threshold (standard deviations)")
        parts.append(figure(plot_lines([Line("", decisions, recording.threshold)], labels), labels.alt + "."))
    return parts


def _goals(recording: Recording) -> list[str]:
    parts = []
    if recording.objective_scores:
        labels = Labels("Score of the objective", "env frame", "score")
        line = Line("", np.arange(len(recording.objective_scores)), recording.objective_scores)
        parts.append(figure(plot_lines([line], labels), labels.alt + "."))
    if recording.clauses:
        lines = [Line(text, np.arange(len(met)), np.array(met, float)) for text, met in recording.clauses.items()]
        labels = Labels("Clauses that are met", "decision", "met (1) or not (0)")
        parts.append(figure(plot_lines(lines, labels), labels.alt + "."))
        rows = [["clause", "met"]] + [
            [text, _percent(np.mean([each for each in met if each is not None]))]
            for text, met in recording.clauses.items()
        ]
        parts.append(table(rows))
    return parts


def _provenance(data: ReportData) -> list[str]:
    facts = {"latentplan": __version__, **data.facts}
    rows = [["fact", "value"], *([name, _shown(value)] for name, value in facts.items())]
    by_name = by_key(to_dict(data.config))
    settings = [["setting", "value"], *([name, _shown(value)] for name, value in by_name.items())]
    folded = (
        f'<details class="wide"><summary>{len(settings) - 1} settings of the agent</summary>{table(settings)}</details>'
    )
    return [table(rows), folded]


def tile(rows: Sequence[Frame]) -> Frame:
    """Rows of pictures (picture, height, width, 3) as one picture, with a grey line between pictures."""
    num, height, width = rows[0].shape[:3]
    size = len(rows) * (height + GAP) - GAP, num * (width + GAP) - GAP, 3
    canvas: Frame = np.full(size, SEPARATOR, np.uint8)
    for row, pictures in enumerate(rows):
        for column, each in enumerate(pictures):
            top, left = row * (height + GAP), column * (width + GAP)
            canvas[top : top + height, left : left + width] = each
    return canvas


def _percent(share: float | np.floating[Any]) -> str:
    return f"{100.0 * float(share):.1f} %"


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {inner}" for name, inner in value.items())
    return value if isinstance(value, str) else json.dumps(value)
