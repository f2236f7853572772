"""Files of older schemas as the present one has them; called where a file is read, so that nothing else knows of them.

1: without what a running episode needs to go on. 2: of one environment, whose reward was not learned. 3: with the
episodes that logged means are over as plain values. 4: with the state of all nouns in one part, "agent". Each lacks
arguments that came later; `arguments.saved_arguments` gives those the constructor's defaults, whatever the schema.
"""

from typing import Any

import torch
from torch import Tensor

MOST_MISSING = 10
"""A table of the summaries of episodes may have this many times the numbers that a file holds of them."""
SPACES = ("observation_space", "action_space")

Config = dict[str, Any]
Tensors = dict[str, dict[str, Tensor]]


def upgraded(config: Config, tensors: Tensors, schema: int) -> tuple[Config, Tensors]:
    """A file's contents in the layout of schema 5.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the contents are not those of the schema.
    """
    if schema >= 5:
        return config, tensors
    own = tensors["agent"]
    episodes, episode_values = _episodes(config, own, schema)
    logs, log_values = _logs(config, own, schema)
    last: dict[str, Tensor] = {name: own[name] for name in ("last_observation", "last_episode_starts") if name in own}
    counters = config["counters"]
    values = {
        "dynamics": config["values"].get("dynamics", {}),
        "transitions": config["values"].get("transitions", {}),
        "task": _task(config),
        "progress": {
            "num_timesteps": counters["num_timesteps"],
            "num_fitted": counters["num_fitted"],
            "num_episodes": counters["_episode_num"],
        },
        "random": {"seeds_environment": config["seeds_environment"]}
        | ({"device": config["device"]} if "device" in config else {}),
        "logs": log_values,
        "episodes": episode_values,
    }
    parts: Tensors = {
        "task": {},
        "dynamics": tensors["dynamics"],
        "transitions": tensors["transitions"],
        "progress": last,
        "random": tensors["generators"],
        "logs": logs,
        "episodes": episodes,
        "spaces": {name: value for name, value in own.items() if name.startswith(SPACES)},
    }
    present: Config = {
        name: config[name] for name in ("class", "arguments", "space_dtypes", "versions") if name in config
    }
    if "arguments" in present and isinstance(present["arguments"], dict):
        # Then every named agent planned by CEM; of a plain MPCAgent the planner was never saved.
        planner = "cem" if "num_candidates" in present["arguments"] else None
        present["arguments"] = {"planner": planner, **present["arguments"]}
    num_envs = len(config["running"]) if schema > 2 else 1
    return {**present, "num_envs": num_envs, "episode": config.get("episode"), "values": values}, parts


def _task(config: Config) -> dict[str, Any]:
    modelled = config.get("modelled", {"reward": False, "terminated": False})
    about = ("environment", "observation_parts", "reset_options")
    task: dict[str, Any] = {"reward": modelled["reward"], "terminated": modelled["terminated"]}
    task["has_terminated_fn"] = config.get("has_terminated_fn", False)
    task["about_environment"] = {name: config[name] for name in about if name in config}
    return task | ({"to_learn": config["to_learn"]} if "to_learn" in config else {})


def _episodes(config: Config, own: dict[str, Tensor], schema: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
    if schema < 3:  # of one environment
        counters = config["counters"]
        running = [{"index": counters["_episode_index"], "has_explored": counters["_explored_episode"]}]
    else:
        running = config["running"]
    # Every plan was a Gaussian of [H, A]; whose planner's it was, no file said.
    fields = {name: list(own[f"plan.{name}"].shape[1:]) for name in ("mean", "std")}
    values: dict[str, Any] = {"planner": {"class": "CEM", "fields": fields}}
    tensors = {name: own[name] for name in ("plan.mean", "plan.std", "plan.age")}
    for i, episode in enumerate(running):
        values |= {f"{i}.index": int(episode["index"]), f"{i}.has_explored": bool(episode["has_explored"])}
        values[f"{i}.number"] = config["counters"]["_episode_num"] + 1
    for name, value in own.items():
        if name.startswith("record."):
            index, _, field = name.removeprefix("record.").partition(".") if schema > 2 else ("0", "", name[7:])
            tensors[f"{index}.record.{field}"] = value
    return tensors, values


def _logs(config: Config, own: dict[str, Tensor], schema: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
    values = {"waiting": config.get("pending_logs", []), "run": config.get("log_run")}
    if schema > 3:
        return {name: value for name, value in own.items() if name.startswith("ep_")}, values
    infos = config["episode_infos"]
    names = dict.fromkeys(name for info in infos for name in info)
    if len(names) * len(infos) > MOST_MISSING * sum(map(len, infos)):
        raise ValueError(f"{len(infos)} summaries of episodes have {len(names)} names between them")
    columns = {f"ep_info.{name}": [float(info.get(name, "nan")) for info in infos] for name in names}
    columns["ep_successes"] = [float(success) for success in config["episode_successes"]]
    return {name: torch.tensor(column, dtype=torch.float64, device="cpu") for name, column in columns.items()}, values
