"""Published returns of training from pixels, to compare with the learning curves of this project.

Episode returns of `dm_control.suite`, at most 1,000; frames are simulator control steps, before action repeat. Read
from the result files in the public repositories of TD-MPC2 (nicklashansen/tdmpc2, 3 seeds), DreamerV3
(danijar/dreamerv3, 10 seeds, training episodes), MR.Q (facebookresearch/MRQ, 10 seeds) and DrQ-v2
(facebookresearch/drqv2), off the curve of EfficientZero V2 (Shengjiewang-Jason/EfficientZeroV2), and from the tables of
ResAct (2025) and COVR (2026), the latter with an outside vision-language model. The returns of PlaNet, Dreamer, CURL
and DrQ come from these two tables.
"""

from __future__ import annotations

from collections.abc import Mapping

FRAMES = (100_000, 200_000, 500_000, 1_000_000)
Row = tuple[float | None, ...]  # a return, or None, for each of FRAMES

# Action repeat 2 on every task.
_REPEAT_2: dict[str, dict[str, Row]] = {
    "walker-walk": {
        "TD-MPC2": (464, 836, 949, 940),
        "DreamerV3": (605, 876, 945, 962),
        "MR.Q": (568, 856, 953, 970),
        "DrQ-v2": (170, 428, 722, 767),
        "EfficientZero V2": (642, 891),
    },
    "walker-stand": {
        "DreamerV3": (909, 946, 972, 975),
        "MR.Q": (892, 970, 976, 981),
        "DrQ-v2": (324, 677, 957),
        "EfficientZero V2": (837, 954),
    },
    "walker-run": {
        "TD-MPC2": (194, 359, 677, 672),
        "DreamerV3": (218, 380, 610, 682),
        "MR.Q": (165, 350, 517, 616),
        "DrQ-v2": (104, 217, 437, 546),
        "EfficientZero V2": (169, 327),
    },
    "cartpole-swingup": {
        "DreamerV3": (597, 794, 843, 862),
        "MR.Q": (477, 815, 845, 868),
        "DrQ-v2": (626, 807, 846),
        "EfficientZero V2": (626, 760),
    },
    "cartpole-balance": {
        "DreamerV3": (946, 984, 994, 996),
        "MR.Q": (986, 990, 997, 999),
        "DrQ-v2": (987, 983, 988),
        "EfficientZero V2": (851, 902),
    },
    "reacher-easy": {
        "TD-MPC2": (360, 640, 918, 982),
        "DreamerV3": (376, 682, 821, 930),
        "MR.Q": (449, 778, 928, 980),
        "DrQ-v2": (250, 353, 751, 939),
        "EfficientZero V2": (907, 952),
    },
    "cheetah-run": {
        "TD-MPC2": (286, 343, 455, 537),
        "DreamerV3": (308, 418, 661, 822),
        "MR.Q": (254, 473, 671, 776),
        "DrQ-v2": (273, 479, 603, 729),
        "EfficientZero V2": (463, 617),
    },
    "finger-spin": {
        "TD-MPC2": (981, 971, 983, 985),
        "DreamerV3": (503, 545, 572, 589),
        "MR.Q": (744, 845, 916, 965),
        "DrQ-v2": (325, 544, 789),
        "EfficientZero V2": (861, 923),
    },
    "ball_in_cup-catch": {
        "DreamerV3": (864, 949, 970, 971),
        "MR.Q": (194, 538, 897, 977),
        "DrQ-v2": (359, 511, 844),
        "EfficientZero V2": (958, 972),
    },
    "pendulum-swingup": {
        "DreamerV3": (306, 553, 642, 747),
        "MR.Q": (715, 826, 840, 829),
        "DrQ-v2": (235, 494, 840),
        "EfficientZero V2": (668, 718),
    },
}

# Returns after 100,000 frames; action repeat 8 for cartpole, 4 for reacher, cheetah and cup, 2 for finger and walker.
_METHODS = tuple(f"{name} (own repeat)" for name in ("PlaNet", "Dreamer", "CURL", "DrQ", "ResAct", "COVR"))
METHODS = ("TD-MPC2", "DreamerV3", "MR.Q", "DrQ-v2", "EfficientZero V2", *_METHODS)
_OWN_REPEAT: dict[str, tuple[float, ...]] = {
    "cartpole-swingup": (563, 326, 582, 759, 819, 872),
    "reacher-easy": (82, 314, 538, 601, 917, 969),
    "cheetah-run": (165, 235, 299, 344, 503, 504),
    "walker-walk": (224, 277, 403, 612, 772, 802),
    "finger-spin": (560, 341, 767, 901, 974, 976),
    "ball_in_cup-catch": (0, 246, 769, 913, 948, 960),
}


def published_returns_of(task: str) -> dict[str, Mapping[int, float]]:
    """Returns of each method on a task `domain-name`, by env frames; empty for a task without published returns.

    The mark `own repeat` stands at methods with the action repeat of the project's `configs/` instead of 2.
    """
    rows: dict[str, Row] = dict(_REPEAT_2.get(task, {}))
    for method, value in zip(_METHODS, _OWN_REPEAT.get(task, ()), strict=False):
        rows[method] = (value,)
    return {
        method: {frames: value for frames, value in zip(FRAMES, row, strict=False) if value is not None}
        for method, row in rows.items()
    }
