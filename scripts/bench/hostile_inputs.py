"""Hostile command lines and files, each of which has to be refused in one line without running anything of it.

A word may hold `{folder}`, the folder of the files, and `{agent}`, the checkpoint of a trained agent.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import struct
from pathlib import Path
from typing import Any

LONG = "a" * 100_000
MARK = "executed"  # a file of this name in the folder shows that an input was executed
TOUCH = "touch {folder}/" + MARK
DIGITS = "9" * 4_000
AGENT = ("eval", "--checkpoint")
TRAIN = ("train", "--run-dir", "{folder}/run", "--device", "cpu")

# Files of settings, by name; `write_files` makes them.
SETTINGS: dict[str, str | bytes] = {
    "brackets": "[" * 100_000,
    "braces": "{a: " * 100_000,
    "dashes": "- " * 100_000,
    "indented": "\n".join(" " * depth + "a:" for depth in range(300)),
    "nested-value": "env: " + "[" * 100 + "]" * 100,
    "laughs": "a: &a [x, x]\n"
    + "\n".join(f"{b}: &{b} [*{a}, *{a}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
    "self": "env: &a [*a]",
    "merge": "a: &a {domain: walker}\nenv: {<<: *a}",
    "system": f"env: !!python/object/apply:os.system ['{TOUCH}']",
    "new": f"env: !!python/object/new:os.system ['{TOUCH}']",
    "name": "env: !!python/name:os.system ''",
    "module": "env: !!python/module:os ''",
    "tag": f"env: !shell '{TOUCH}'",
    "binary": bytes(range(256)) * 4,
    "zeros": bytes(1000),
    "pickle": f"cposix\nsystem\n(S'{TOUCH}'\ntR.".encode(),
    "utf16": "env: {domain: walker}".encode("utf-16"),
    "large": "# " + "x" * 2_000_000,
    "quote": 'env: {domain: "walker}',
    "tab": "env:\n\tdomain: walker",
    "text": "walker",
    "number": "3",
    "list": "- env\n- run",
    "section-number": "env: 3",
    "section-list": "run: [1, 2]",
    "section-unknown": "enviroment: {domain: walker}",
    "section-long": f"{LONG}: {{domain: walker}}",
    "section-null-key": "null: {domain: walker}",
    "setting-unknown": "env: {domian: walker}",
    "setting-long": f"env: {{? {LONG} : walker}}",
    "setting-number": "env: {1: 2}",
    "domain-long": f"env: {{domain: {LONG}}}",
    "domain-list": "env: {domain: [walker]}",
    "domain-path": "env: {domain: ../../../etc/passwd}",
    "task-path": "env: {domain: walker, task: ../../walk}",
    "suite-code": f"env: {{suite: 'os:system', domain: '{TOUCH}'}}",
    "digits": f"run: {{frames: {DIGITS}}}",
    "hexadecimal": f"run: {{frames: 0x{'f' * 100_000}}}",
    "octal": f"run: {{seed: 0{'7' * 100_000}}}",
    "sexagesimal": f"run: {{seed: {':'.join(['59'] * 5_000)}}}",
    "nan": "run: {minutes: .nan}",
    "infinity": "run: {minutes: .inf}",
    "date": "run: {frames: 2020-01-01}",
    "no-date": "run: {frames: 2020-13-45}",
    "dictionary": "run: {frames: {a: 1}}",
    "true": "run: {frames: true}",
    "surrogate": 'env: {domain: "\\ud800"}',
    "null-byte": 'env: {domain: walker, task: "wa\\0lk"}',
    "base64": "env: {domain: !!binary aGVsbG8=}",
    "space-digits": f"planner: {{horizon: {{low: 1, high: {DIGITS}}}}}",
    "space-samples": "planner: {num_samples: {low: 64, high: 1e17}}",
    "channels": f"model: {{encoder_channels: [{', '.join(['8'] * 10_000)}]}}",
    "goals": f'collection: {{goals: [\'__import__("os").system("{TOUCH}")\'], goal_share: 0.5}}',
}
PLANNER = {
    "num_samples": ("1e9", "1e10", "1e17", "1e18", "-1", "nan", "0x10", DIGITS),
    "horizon": ("1e8", "1e17", "0", "1e400"),
    "num_iterations": ("1e12",),
    "gradient_steps": ("1e15",),
    "num_elites": ("1e9",),
    "init_std": ("1e300", "nan"),
    "method": ("os.system", "../cem", LONG),
}
FLAGS = {
    "--env.action_repeat": ("1e9", "0"),
    "--env.num_envs": ("5000", "1e17", "1000"),
    "--env.camera": ("1e17",),
    "--learning.batch_size": ("1e9",),
    "--learning.sequence_length": ("1e6",),
    "--learning.imagination_starts": ("1e12",),
    "--learning.imagination_horizon": ("1e12",),
    "--learning.random_shift": ("1e9",),
    "--model.deter_dim": ("1e9",),
    "--model.hidden_dim": ("1e9",),
    "--model.latent_dim": ("1e12",),
    "--model.num_bins": ("1e13",),
    "--model.encoder_channels": ("[1e9]", "[" * 100_000, "[]", "[0]", "[1" + ",1" * 40_000 + "]"),
    "--collection.prefill_decisions": ("1e15",),
    "--collection.round_decisions": ("1e15",),
    "--collection.updates_per_decision": ("1e9",),
    "--collection.goals": ("[" * 50_000, '["' + "(" * 50_000 + '"]'),
    "--replay.capacity": ("1e15",),
    "--evaluation.episodes": ("1e17",),
    "--frames": ("1e15", "-1", "0", "many", LONG),
    "--minutes": ("inf", "-1", "0"),
    "--updates": ("1e15.5", "-1", "0", "many"),
    "--replay.demonstrations": (LONG, "{folder}/missing", "{folder}/file", "/dev/null", ""),
    "--collection.keep_episodes": ("{folder}/file", "{folder}/file/episodes", LONG, ""),
    "--seed": ("-1", DIGITS),
    "--domain": ("wlaker", LONG, f"$({TOUCH})", "\x1b[31mred\x1b[0m", "a\nb", "{0.__class__}", "%s%n"),
    "--task": ("fly", LONG, "../walk", f"`{TOUCH}`"),
    "--device": ("cuda:99", "meta"),
    "--preset": ("../gpu",),
    "--threads": ("1e9",),
    "--run.threads": ("1e9", "0"),
    "--run.devices": ("1e9", "0", "-1", "many", "3", LONG),
    "--run.nodes": ("1e9", "0", "2", "many"),
    "--run.strategy": ("fsdp", "", LONG),
    "--run.ray-address": ("nowhere", LONG),
    "--collection.backend": ("dask", "", LONG),
    "--collection.workers": ("1e9", "0", "many", LONG),
    "--collection.asynchronous": ("true", "perhaps"),
    "--env-id": (
        "os:system",
        "os.path:InvertedPendulum-v9",
        f"$({TOUCH}):Reach-v0",
        "../x:Reach-v0",
        LONG,
        "",
        "a:b:c",
    ),
    "--env-kwargs": ("", "[1]", "[" * 100_000, LONG, f'{{"a": {DIGITS}}}'),
    "--env.pixels": ("video", LONG),
    "--run-dir": ("{folder}/file", "{folder}/file/run", LONG, ""),
    "--resume": ("{folder}/nothing", "{folder}/file", "/dev/zero", LONG),
    "--config": (
        "/dev/zero",
        "{folder}/pipe",
        "{folder}",
        "{folder}/nothing",
        "{folder}/loop",
        LONG,
        "{folder}/pipe-link",
    ),
}
EVALUATION = {
    "--objective": (
        f"__import__('os').system('{TOUCH}')",
        "goal:/dev/zero",
        "goal:{folder}/pipe",
        "goal:{folder}/file",
        "(" * 100_000,
        "cart" + " + cart" * 15_000,
        "; " * 50_000,
        LONG,
        DIGITS,
        "cart < 1e999",
        "cart.__class__ < 1",
        "eval(cart) < 1",
        "",
    ),
    "--constraint": ("; " * 50_000, "cart", "lambda: cart", LONG),
    "--latency": ("/dev/zero", "{folder}/pipe", "{folder}/brackets.yaml", "{folder}/binary.yaml", "{folder}", LONG),
    "--episodes": ("1e17", "0", "nan"),
    "--control-hz": ("0", "inf", "-1"),
    "--mode": ("os.system", LONG),
    "--json": ("{folder}", "{folder}/file/result.json", "/dev/null", LONG),
    "--video": ("film.exe", "{folder}/nothing/film.mp4"),
    "--seed": (DIGITS,),
    "--planning-budget": ("2",),
}
OTHERS = (
    (LONG,),
    ("tarin",),
    ("--print-completion", "fish"),
    ("train", LONG),
    ("train", f"--{LONG}", "1"),
    ("train", f"--{LONG}=1"),
    ("train", "--frames"),
    ("distill",),
    ("distill", "--checkpoint", "{agent}", "--rounds", "1e17"),
    ("distill", "--checkpoint", "{agent}", "--batch-size", "1e17"),
    ("distill", "--checkpoint", "{agent}", "--planner.num_samples", "1e10"),
    ("distill", "--checkpoint", "{folder}/pipe"),
    ("distill", "--resume", "{folder}/nothing"),
    ("goals", "--checkpoint", "{agent}", "--starts", "1e12"),
    ("goals", "--checkpoint", "{agent}", "--hidden-dim", "1e9"),
    ("goals", "--checkpoint", "{agent}", "--horizon", "1e12"),
    ("goals", "--resume", "{folder}/file"),
    ("card", "--checkpoint", "{agent}", "--episodes", "1e17"),
    ("card", "--checkpoint", "{agent}", "--licence", "mit\nmodel-index: []"),
    ("card", "--checkpoint", "{folder}/info-digits"),
    ("push", "--checkpoint", "{agent}", LONG),
    ("push", "--checkpoint", "{agent}", "../../etc/passwd"),
    ("push", "--checkpoint", "{folder}/weights-pickle", "owner/name"),
    ("push", "--checkpoint", "{agent}", "owner/name", "--endpoint", "file:///etc/passwd"),
    ("pull", "owner/name", "--out", "{folder}"),
    ("pull", "owner/name", "--out", LONG, "--endpoint", "http://127.0.0.1:9"),
    ("pull", "owner/name", "--out", "{folder}/new", "--endpoint", "http://127.0.0.1:9"),
    ("sweep",),
    ("sweep", "--space", "/dev/zero", "--frames", "1000"),
    ("sweep", "--space", "{folder}/pipe", "--frames", "1000"),
    ("sweep", "--space", "{folder}/goals.yaml", "--frames", "1000"),
    ("sweep", "--space", "{folder}/space-digits.yaml", "--frames", "1000"),
    ("sweep", "--space", "{folder}/space-samples.yaml", "--frames", "1000"),
    ("sweep", "--space", "{folder}/space-samples.yaml", "--trials", "1e17"),
    ("view", "--checkpoint", "{agent}", "--port", "99999"),
    ("view", "--checkpoint", "{agent}", "--port", "0", "--host", LONG),
    ("view", "--checkpoint", "{agent}", "--port", "0", "--host", "256.0.0.1"),
    ("view", "--checkpoint", "{agent}", "--objective", "(" * 1000),
    ("view", "--checkpoint", "{agent}", "--planner.num_samples", "1e10"),
    ("view", "--checkpoint", "{folder}/pipe"),
    ("export", "--checkpoint", "{agent}", "--out", "{folder}"),
    ("export", "--checkpoint", "{agent}", "--out", "{folder}/file/actor.pt2"),
    ("export", "--checkpoint", "{agent}", "--out", LONG),
    ("export", "--checkpoint", "{agent}", "--out", "{folder}/actor.pt2", "--format", "exe"),
)
BY_MODULE = {"suite": "gymnasium", "domain": "gymnasium", "task": "antigravity:Reach-v0"}
CHECKPOINTS = (
    "no-info",
    "info-brackets",
    "info-digits",
    "info-list",
    "info-binary",
    "info-pipe",
    "info-large",
    "info-domain",
    "info-module",
    "info-deter",
    "info-action",
    "info-samples",
    "info-config",
    "weights-empty",
    "weights-cut",
    "weights-pickle",
    "weights-header",
    "weights-pipe",
    "weights-sealed",
    "manifest-brackets",
    "manifest-pipe",
    "/dev/zero",
    "nothing",
    "file",
)


def list_cases() -> dict[str, tuple[str, ...]]:
    """The command lines, by a short name."""
    cases: dict[str, tuple[str, ...]] = {}
    for name in SETTINGS:
        cases[f"config {name}"] = (*TRAIN, "--config", f"{{folder}}/{name}.yaml")
    for setting, values in PLANNER.items():
        for index, value in enumerate(values):
            cases[f"train {setting} {index}"] = (*TRAIN, f"--planner.{setting}", value)
            cases[f"eval {setting} {index}"] = (*AGENT, "{agent}", f"--planner.{setting}", value)
    for flag, values in FLAGS.items():
        for index, value in enumerate(values):
            given = TRAIN[:1] if flag == "--resume" else TRAIN
            cases[f"train {flag} {index}"] = (*given, flag, value)
    for flag, values in EVALUATION.items():
        for index, value in enumerate(values):
            needed = ("--control-hz", "50") if flag == "--latency" else ()
            cases[f"eval {flag} {index}"] = (*AGENT, "{agent}", *needed, flag, value)
    for name in CHECKPOINTS:
        cases[f"agent {name}"] = (*AGENT, name if name.startswith("/") else f"{{folder}}/{name}")
    for index, words in enumerate(OTHERS):
        cases[f"other {index}"] = words
    return cases


def write_files(folder: Path, agent: Path) -> None:
    """Write the files that the command lines name.

    Args:
        folder: An empty folder.
        agent: Checkpoint of a trained agent, of which damaged copies are made.
    """
    (folder / "file").write_text("a file")
    os.mkfifo(folder / "pipe")
    (folder / "pipe-link").symlink_to(folder / "pipe")
    (folder / "loop").symlink_to(folder / "loop")
    for name, content in SETTINGS.items():
        (folder / f"{name}.yaml").write_bytes(_filled(content, folder))
    info = json.loads((agent / "info.json").read_text())
    infos: dict[str, str | bytes] = {
        "info-brackets": "[" * 100_000,
        "info-digits": json.dumps(info)[:-1] + f', "env_frames": {"9" * 5_000}}}',
        "info-list": "[]",
        "info-binary": bytes(range(256)),
        "info-large": json.dumps(info | {"note": "x" * 2**25}),
        "info-domain": json.dumps(info | {"config": _changed(info, "env", domain="../../etc")}),
        "info-module": json.dumps(info | {"config": _changed(info, "env", **BY_MODULE)}),
        "info-deter": json.dumps(info | {"config": _changed(info, "model", deter_dim=10**9)}),
        "info-action": json.dumps(info | {"action_dim": 10**12}),
        "info-samples": json.dumps(info | {"config": _changed(info, "planner", num_samples=10**12)}),
        "info-config": json.dumps(info | {"config": {"env": [LONG]}}),
    }
    weights: dict[str, bytes] = {
        "weights-empty": b"",
        "weights-cut": (agent / "weights.safetensors").read_bytes()[:1000],
        "weights-pickle": SETTINGS["pickle"] if isinstance(SETTINGS["pickle"], bytes) else b"",
        "weights-header": struct.pack("<Q", 2**62) + b"{}",
        "weights-sealed": b"",
    }
    for name in ("weights-cut", "weights-pickle", "weights-header"):  # so that the weights themselves are refused
        infos[name] = json.dumps(info | {"sha256": hashlib.sha256(weights[name]).hexdigest()})
    for name in CHECKPOINTS:
        if name not in ("nothing", "file") and not name.startswith("/"):
            given = _filled(weights[name], folder) if name in weights else None
            _damage(folder / name, agent, infos.get(name), given)


def _damage(copy: Path, agent: Path, info: str | bytes | None, weights: bytes | None) -> None:
    """Copies an agent and damages the copy; without its manifest, so that the damage itself has to be noticed."""
    shutil.copytree(agent, copy)
    manifest = copy / "manifest.json"
    if copy.name != "weights-sealed":
        manifest.unlink(missing_ok=True)
    if copy.name == "manifest-brackets":
        manifest.write_text("[" * 100_000)
    for path, content in ((copy / "info.json", info), (copy / "weights.safetensors", weights)):
        if content is not None:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
    if copy.name == "no-info":
        (copy / "info.json").unlink()
    for name in ("info.json", "weights.safetensors", "manifest.json"):
        if copy.name == f"{Path(name).stem}-pipe":
            (copy / name).unlink(missing_ok=True)
            os.mkfifo(copy / name)


def _filled(content: str | bytes, folder: Path) -> bytes:
    """The content of a file, with the folder in the place of `{folder}`."""
    content = content if isinstance(content, bytes) else content.encode()
    return content.replace(b"{folder}", os.fsencode(folder))


def _changed(info: dict[str, Any], section: str, **values: Any) -> dict[str, Any]:
    return {**info["config"], section: {**info["config"][section], **values}}
