"""The card of an agent: a README.md in the format of the model hub, made of what the agent remembers of itself.

A card is front matter in YAML and a text in Markdown. Its last line, the seal, holds the checksums of the card and of
the agent's description: a card that was edited by hand, or that describes an earlier agent, is told by it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from latentplan.config import USER_DOMAIN, Config, PlannerConfig, from_dict, to_dict
from latentplan.config.checks import LONGEST_WORD
from latentplan.config.env_id import as_file_name, is_by_id, repeat_flag
from latentplan.config.files import to_yaml
from latentplan.config.run_results import read_log
from latentplan.config.spaces import Spaces

LICENCE = "mit"  # of this project, as the model hub spells it
PIPELINE = "reinforcement-learning"
TAGS = (PIPELINE, "model-based-reinforcement-learning", "world-model", "planning", "latentplan")
SHOWN_SECTIONS = ("env", "model", "planner", "learning", "collection")
LARGEST_RETURN = 1e12
QUOTE = "'"  # in place of a backtick, which would end code
_SEAL = re.compile(r"<!-- latentplan card: info ([0-9a-f]{64}), text ([0-9a-f]{64}) -->\n\Z")

Interval = Callable[[Sequence[float]], tuple[float, float]]


class CardReturn(NamedTuple):
    """The mean return of one mode of acting.

    Attributes:
        mode: `planner` or `actor`.
        mean: Mean return over the episodes.
        num_episodes: Number of episodes.
        interval: Ends of the 95 % interval of the mean; None where the single returns are unknown, or there is one.
        origin: When the episodes were played, such as "at the end of the training run".
        is_measured: Whether the episodes were played for this card, and not recorded earlier.
    """

    mode: str
    mean: float
    num_episodes: int
    interval: tuple[float, float] | None
    origin: str
    is_measured: bool = False


@dataclass(frozen=True)
class CardData:
    """What a card tells.

    Attributes:
        info: Description of the agent, the content of its `info.json`.
        config: Settings of the agent.
        spaces: Shape of frames and actions.
        returns: Known returns; empty where none are known.
        film: Name of the film beside the card; None without one.
        licence: Identifier of the licence, as the model hub spells it.
    """

    info: Mapping[str, Any]
    config: Config
    spaces: Spaces
    returns: Sequence[CardReturn] = ()
    film: str | None = None
    licence: str = LICENCE


class Seal(NamedTuple):
    """What the last line of a card says.

    Attributes:
        info_sha256: Checksum of the `info.json` that the card describes.
        is_intact: Whether the card is as it was written.
    """

    info_sha256: str
    is_intact: bool


def render_card(data: CardData) -> str:
    """The card without its seal; parts of which the agent knows nothing are left out."""
    parts = [
        f"---\n{to_yaml(_front_matter(data))}---\n",
        *_introduction(data),
        *_task(data),
        *_returns(data),
        *_training(data),
        *_use(data),
        f"## Licence\n\nThe licence of these files is {_code(data.licence)}.\n",
    ]
    return "\n".join(parts)


def seal_card(text: str, info_sha256: str) -> str:
    """A card with its seal.

    Args:
        text: Result of `render_card`.
        info_sha256: Checksum of the `info.json` that the card describes.
    """
    return f"{text}\n<!-- latentplan card: info {info_sha256}, text {_checksum(text)} -->\n"


def read_seal(card: str) -> Seal | None:
    """The seal of a card; None for a text that `seal_card` did not make."""
    found = _SEAL.search(card)
    if found is None:
        return None
    return Seal(found[1], found[2] == _checksum(card[: found.start()].removesuffix("\n")))


def recorded_returns(info: Mapping[str, Any], config: Config, interval: Interval) -> list[CardReturn]:
    """The returns in a description that were measured with exactly the weights of the agent.

    A distilled agent also remembers the returns of the agent that it was made from; these are left out. So is the
    planner's return of a distillation that searched with other settings than the agent's own.

    Args:
        info: Content of `info.json`.
        config: Settings of the agent.
        interval: Ends of the 95 % interval of the mean of returns.
    """
    distilled = info.get("distilled")
    if isinstance(distilled, dict):
        origin = "on the test starts of the distillation"
        found = {"planner": _planner_after(distilled, config.planner), "actor": distilled.get("returns_after")}
    else:
        origin, final = "at the end of the training run", info.get("final_evaluation")
        found = {mode: final.get(mode) for mode in ("planner", "actor")} if isinstance(final, dict) else {}
    results = [
        summarize_returns(mode, returns, interval, origin) for mode, returns in found.items() if _are_returns(returns)
    ]
    return results or ([] if isinstance(distilled, dict) else _logged_returns(info, config))


def summarize_returns(
    mode: str, returns: Sequence[float], interval: Interval, origin: str, *, is_measured: bool = False
) -> CardReturn:
    """One entry of a card from the returns of single episodes; see `CardReturn`."""
    ends = interval(returns) if len(returns) > 1 else None
    return CardReturn(mode, float(np.mean(returns)), len(returns), ends, origin, is_measured)


def name_task(config: Config, info: Mapping[str, Any]) -> str:
    """The task as domain-task, or the id of an environment that gymnasium's registry knows."""
    return str(info["task"] if is_by_id(config.env) else f"{info['domain']}-{info['task']}")


def _planner_after(distilled: Mapping[str, Any], planner: PlannerConfig) -> Any:
    """The planner's returns with the actor that a distillation kept; None if they are unknown or of another search."""
    try:
        searched = from_dict({"planner": distilled["planner"]}).planner
    except (AttributeError, KeyError, TypeError, ValueError):
        return None
    if searched != planner:
        return None
    before = distilled.get("returns_planner") if distilled.get("kept_round") is None else None
    return distilled.get("returns_planner_after", before)


def _logged_returns(info: Mapping[str, Any], config: Config) -> list[CardReturn]:
    """The means of the evaluation during training whose weights are those of the agent."""
    clocks = info["env_frames"], info.get("updates")
    entry = next((entry for entry in read_log(info) if (entry.env_frames, entry.updates) == clocks), None)
    if entry is None:
        return []
    origin = "at the evaluation of the training run that this agent is from"
    values = {"planner": entry.planner, "actor": entry.actor}
    episodes = config.evaluation.episodes
    return [CardReturn(mode, float(mean), episodes, None, origin) for mode, mean in values.items() if _is_return(mean)]


def _are_returns(values: Any) -> bool:
    """Whether a value of a description is a list of numbers that can be returns."""
    return isinstance(values, list) and len(values) > 0 and all(map(_is_return, values))


def _is_return(value: Any) -> bool:
    return isinstance(value, int | float) and -LARGEST_RETURN <= value <= LARGEST_RETURN


def _front_matter(data: CardData) -> dict[str, Any]:
    name = as_file_name(name_task(data.config, data.info))
    front: dict[str, Any] = {
        "license": data.licence,
        "library_name": "latentplan",
        "pipeline_tag": PIPELINE,
        "tags": list(dict.fromkeys((*TAGS, data.config.env.suite, name))),
    }
    returns = [entry for entry in data.returns if entry.is_measured] or data.returns
    if returns:
        metrics = [
            {
                "type": "mean_reward",
                "value": round(entry.mean, 1),
                "name": f"mean_reward ({entry.mode}, {entry.num_episodes} episodes {entry.origin})",
                "verified": False,
            }
            for entry in returns
        ]
        result = {
            "task": {"type": PIPELINE, "name": PIPELINE},
            "dataset": {"name": name, "type": name},
            "metrics": metrics,
        }
        front["model-index"] = [{"name": name, "results": [result]}]
    return front


def _introduction(data: CardData) -> list[str]:
    vectors = data.spaces.vector_dim
    seen = f"camera frames and {vectors} numbers beside each frame" if vectors else "camera frames alone"
    parts = [
        f"# {as_file_name(name_task(data.config, data.info))}\n",
        f"An agent of latentplan, which learned {_code(name_task(data.config, data.info))} from {seen}. It searches a "
        f"plan in the {data.config.model.latent_dim}-dimensional latent of its world model at every decision (mode "
        "`planner`), or takes the action of a learned policy (mode `actor`).\n",
    ]
    if data.film is not None:
        parts.append(
            f"[{data.film}]({data.film}) shows the planner's first episode: left the camera, right the decoded end of "
            "the plan.\n"
        )
    return parts


def _task(data: CardData) -> list[str]:
    env, spaces = data.config.env, data.spaces
    choices = sum(num > 0 for num in spaces.choices)
    size = f"{data.info['action_dim']} in [-1, 1]" + (f", {choices} of them categories" if choices else "")
    rows = {
        "suite": _code(env.suite),
        "task": _code(name_task(data.config, data.info)),
        "reward": "the task's" if env.objective is None else _code(env.objective),
        "frame": f"uint8 {spaces.frame_shape}, of {spaces.cameras} camera{'s' if spaces.cameras > 1 else ''}",
        "numbers of an action": size,
        "control steps of an action": env.action_repeat,
        "discount of a decision": f"{data.info['discount']:g}",
    }
    if env.kwargs != "{}":
        rows["arguments"] = _code(env.kwargs)
    return ["## Task\n", _table(["", ""], list(rows.items()))]


def _returns(data: CardData) -> list[str]:
    parts = ["## Returns\n"]
    if data.returns:
        rows = [
            (each.mode, each.num_episodes, f"{each.mean:.1f}", _ends(each), _plain(each.origin))
            for each in data.returns
        ]
        parts += [
            _table(["mode", "episodes", "mean return", "95 % interval of the mean", "measured"], rows),
            "All are returns of one agent, from one training run.\n",
        ]
    else:
        parts.append("The folder of the agent holds no returns of these weights.\n")
    if any(entry.mode == "planner" and not entry.is_measured for entry in data.returns):
        parts.append(
            "The planner's return is that of its search at that time. `config.planner` in `info.json` is its search "
            "now, which may have been set since.\n"
        )
    if data.config.env.domain == USER_DOMAIN:
        return [
            *parts,
            "The environment is made by a function of its author, so that `latentplan.evaluation.evaluate_agent` has "
            "to measure returns from Python.\n",
        ]
    folder = as_file_name(name_task(data.config, data.info))
    command = f"python -m latentplan eval --checkpoint {folder} --episodes 10{repeat_flag(data.config.env)}"
    return [*parts, "This command measures the planner's return, and `--mode actor` the actor's:\n", _block(command)]


def _training(data: CardData) -> list[str]:
    info, learning = data.info, data.config.learning
    rows: dict[str, Any] = {"env frames (control steps, before action repeat)": f"{info['env_frames']:,}"}
    for name in ("updates", "minutes"):
        if name in info:
            rows[name] = f"{info[name]:,.0f}"
    rows["seed"] = data.config.run.seed
    if learning.curriculum_task is not None:
        frames = f"in the first {learning.curriculum_frames:,} frames"
        rows["other reward first"] = f"that of {_code(learning.curriculum_task)}, {frames}"
    if isinstance(distilled := info.get("distilled"), dict):
        kept, decisions = distilled.get("kept_round"), distilled.get("decisions")
        more = f", after {decisions:,} decisions more" if isinstance(decisions, int) else ""
        rows["distilled from the planner"] = "the actor of the run was kept" if kept is None else f"a new actor{more}"
    if isinstance(info.get("goals"), dict):
        rows["goals"] = "learned to pursue boxes of named quantities"
    if "version" in info:
        rows["latentplan"] = _code(info["version"])
    if info.get("renderer"):
        rows["renderer"] = _code(info["renderer"].get("renderer", "unknown"))
    rows["SHA-256 of the weights"] = _code(info["sha256"])
    sections = {name: fields for name, fields in to_dict(data.config).items() if name in SHOWN_SECTIONS}
    settings = f"<details>\n<summary>Settings</summary>\n\n{_block(to_yaml(sections), 'yaml')}\n</details>\n"
    return ["## Training\n", _table(["", ""], list(rows.items())), settings]


def _use(data: CardData) -> list[str]:
    folder, spaces = as_file_name(name_task(data.config, data.info)), data.spaces
    lines = [
        "import numpy as np\n",
        "from latentplan import load_agent\n",
        f'agent = load_agent("{folder}")  # the folder of this file',
        f"frame = np.zeros({spaces.frame_shape}, dtype=np.uint8)  # a picture of the camera",
    ]
    seen = "frame"
    if spaces.vector_dim:
        seen = "(frame, vectors)"
        lines.append(f"vectors = np.zeros({spaces.vector_dim}, dtype=np.float32)  # the numbers beside it")
    lines += [
        f"action = agent.act({seen})  # float32 ({data.info['action_dim']},), in [-1, 1]",
        "agent.reset()  # before the next episode",
    ]
    parts = [
        "## Use\n",
        "`REPO` stands for the name of the repository that this file is in. The agent is checked before it is placed; "
        "nothing of the repository is executed.\n",
        _block(f"python -m latentplan pull REPO --out {folder}"),
        _block("\n".join(lines), "python"),
    ]
    labels = [name for name in data.info.get("labels") or {} if name.isidentifier()]
    if labels:
        names = ", ".join(map(_code, labels))
        parts.append(f"The planner also pursues goals that it was not trained for, over the quantities {names}:\n")
        parts.append(_block(f'agent.set_objective("{labels[0]} -> {data.info["labels"][labels[0]]:g}")', "python"))
    return parts


def _ends(entry: CardReturn) -> str:
    return "" if entry.interval is None else f"{entry.interval[0]:.1f} to {entry.interval[1]:.1f}"


def _table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)


def _block(text: str, language: str = "") -> str:
    """A fenced block, whose text cannot end the fence."""
    return f"```{language}\n{text.replace('```', 3 * QUOTE).rstrip()}\n```\n"


def _code(value: Any) -> str:
    """A value of a description as inline code, on one line and without characters that would end code or table."""
    text = " ".join(str(value)[:LONGEST_WORD].split())
    return f"`{_plain(text)}`"


def _plain(text: str) -> str:
    """A text without characters that would end code or the cell of a table."""
    return text.replace("`", QUOTE).replace("|", "/")


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
