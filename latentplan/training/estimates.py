"""Memory and time of a training run, estimated before its first process starts."""

from __future__ import annotations

import math

from latentplan.config import Config
from latentplan.config.estimates import Part, check_parts, estimate_model, estimate_search
from latentplan.config.files import has_cuda
from latentplan.config.spaces import Spaces
from latentplan.replay.memory import count_replay_bytes, describe_replay, free_memory

UNKNOWN_LENGTH_CAPACITY = 200_000
LEARNING_COPIES = 6  # weights, gradients, two moments, the average, the acting model
PROCESS_BYTES = 60 * 2**20  # of an environment in a process of its own
CONTROL_STEP_S = 1e-5  # of the fastest simulator
LARGEST_DEVICE = 2**40  # bytes that no graphics processor exceeds; torch alone can ask the driver
UPDATE_S = 1e-3  # of the smallest update


def count_replay_rows(config: Config, num_saved: int = 0) -> int:
    """Rows of the replay for collection: `replay.capacity`, or else enough for everything that the run collects.

    Everything fits where episodes have 20 decisions or more on average, or `collection.episode_decisions` if these are
    fewer: each episode takes one row more than it has decisions.

    Of several learning processes, each has a replay for its share. A run that collects nothing has one row for each
    environment, so that it may collect when it resumes.

    Args:
        config: Settings of the run.
        num_saved: Rows that were saved, or the share of them. Without `replay.capacity` all of them fit.
    """
    ranks = config.run.num_ranks
    if not config.collection.enabled:
        return max(config.num_lanes, num_saved)
    if config.replay.capacity is not None:
        return -(-config.replay.capacity // ranks)
    if config.run.frames is None:
        return max(-(-UNKNOWN_LENGTH_CAPACITY // ranks), num_saved)
    # Up to two rounds exceed the budget, and every episode ends with one frame without an action.
    decisions = config.run.frames / config.env.action_repeat
    per_episode = min(config.collection.episode_decisions or 20, 20)
    collected = 2 * config.collection.round_decisions + config.collection.prefill_decisions
    return max(-(-(int((1.0 + 1.0 / per_episode) * decisions) + collected) // ranks), num_saved)


def check_run(config: Config) -> None:
    """Refuses settings that this machine cannot serve, before a simulator or torch is imported.

    Where a graphics processor learns, the sizes of its own memory are checked by torch alone.

    Raises:
        UserError: The parts of the run do not fit into the free memory, or a decision would take minutes.
    """
    on_device = config.run.device != "cpu" and has_cuda()
    devices = config.run.devices  # processes that share the main memory
    learning = [
        estimate_model(config.model, LEARNING_COPIES, frame_size=config.env.frame_size),
        _estimate_update(config),
    ]
    collecting = [_estimate_environments(config), _estimate_rounds(config)]
    search = estimate_search(config.planner, config.model, on_device and not config.collection.overlap)
    replay = [_estimate_replay(config)]
    if not on_device:
        check_parts([*learning, *collecting, *replay, search], free_memory() // devices)
        return
    check_parts([*learning, *(replay if config.replay.on_device else ())], LARGEST_DEVICE, "the device")
    check_parts([*collecting, *(() if config.replay.on_device else replay), search], free_memory() // devices)


def count_frame_bytes(config: Config) -> int:
    """Bytes of a frame, as far as the settings tell: images that an environment of the user adds are not counted."""
    return math.prod(Spaces(frame_size=config.env.frame_size, cameras=max(1, len(config.env.cameras))).frame_shape)


def _estimate_update(config: Config) -> Part:
    learning, model = config.learning, config.model
    sides = [config.env.frame_size // 4 // 2**layer for layer in range(len(model.encoder_channels))]
    pictures = sum(channels * side * side for channels, side in zip(model.encoder_channels, sides, strict=True))
    pictures += 5 * 64 * model.decoder_channels + count_frame_bytes(config) // 4  # the decoded picture
    beliefs = 6 * model.deter_dim + 8 * model.hidden_dim
    ranks = config.run.num_ranks  # which share the batch
    frames = learning.batch_size // ranks * (learning.sequence_length + 1)
    imagined = learning.imagination_starts // ranks * (learning.imagination_horizon + 1)
    num_bytes = frames * (count_frame_bytes(config) + 4 * (pictures + beliefs)) + 4 * imagined * beliefs
    advice = "--learning.batch_size, --learning.sequence_length, --learning.imagination_starts or the horizon there"
    seconds = config.collection.updates_per_decision * UPDATE_S
    if seconds > 1.0:
        advice = "--collection.updates_per_decision"
    return Part("an update", num_bytes, seconds, advice)


def _estimate_environments(config: Config) -> Part:
    num_envs = config.env.num_envs * max(1, config.local_collectors)
    num_bytes = num_envs * PROCESS_BYTES if num_envs > 1 else 0
    return Part("the environments", num_bytes, config.env.action_repeat * CONTROL_STEP_S, "--env.num_envs")


def _estimate_rounds(config: Config) -> Part:
    collection, run = config.collection, config.run
    decisions = max(collection.prefill_decisions, collection.round_decisions)
    if run.frames is not None:
        decisions = min(decisions, -(-run.frames // config.env.action_repeat))
    advice = "--collection.prefill_decisions or --collection.round_decisions"
    return Part("a round of collection", decisions * count_frame_bytes(config), 0.0, advice)


def _estimate_replay(config: Config) -> Part:
    rows = count_replay_rows(config)
    return describe_replay(count_replay_bytes(rows, 1, config.model.deter_dim, 0, count_frame_bytes(config)))
