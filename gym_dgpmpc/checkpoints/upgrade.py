"""Files of older schemas as the present one has them; called where a file is read, so that nothing else knows of them.

1: without what a running episode needs to go on. 2: of one environment, whose reward was not learned. 3: with the
episodes that logged means are over as plain values. 4: with the state of all nouns in one part, "agent". 5: with one
chain of a deep Gaussian process, whose hyperparameters were optimised. Each lacks arguments that came later;
`arguments.saved_arguments` gives those the constructor's defaults, whatever the schema.
"""

from typing import Any

import torch
from torch import Tensor

MOST_MISSING = 10
"""A table of the summaries of episodes may have this many times the numbers that a file holds of them."""
SPACES = ("observation_space", "action_space")
ONE_CHAIN = {"num_chains": 1, "hyperparameters": "optimised"}
"""Arguments that make a deep Gaussian process what it was up to schema 5."""
OLD_DEFAULTS = {
    "step_size": 0.02,
    "window_size": 100,
    "hyperparameters_every": 1,
    "learning_rate": 0.01,
    "num_inducing": 200,
    "num_features": 128,
    "refresh": "step",
    "add_noise": False,
}
"""Defaults of that time, of arguments that a file may lack."""

Config = dict[str, Any]
Tensors = dict[str, dict[str, Tensor]]


def upgraded(config: Config, tensors: Tensors, schema: int) -> tuple[Config, Tensors]:
    """A file's contents in the layout of schema 6.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the contents are not those of the schema.
    """
    if schema < 5:
        config, tensors = _by_noun(config, tensors, schema)
    return _with_chains(config, tensors) if schema < 6 else (config, tensors)


def _with_chains(config: Config, tensors: Tensors) -> tuple[Config, Tensors]:
    """Schema 5 as 6: chains are a leading axis of what a deep Gaussian process holds, of the pool the second."""
    arguments, held = config.get("arguments"), tensors["dynamics"]
    if isinstance(arguments, dict) and "sample_spacing" in arguments:  # which the deep Gaussian process alone has
        num_features = arguments.get("num_features")
        # Features are pairs now; which they are is drawn anew for each plan, so one more is no other agent.
        even = {"num_features": num_features + num_features % 2} if isinstance(num_features, int) else {}
        arguments = OLD_DEFAULTS | arguments | even | ONE_CHAIN
        if arguments.pop("resample_steps", 1) == 0:  # now there are exact draws in their place
            arguments["resample_samples"] = 0
        config = config | {"arguments": arguments}
    if "chain.position" not in held:
        return config, tensors
    of_chain = [name for name in held if name == "log_noise" or name.startswith(("chain.", "layers."))]
    upgraded = held | {name: held[name].unsqueeze(0) for name in of_chain} | {"pool": held["pool"].unsqueeze(1)}
    # The latents of inner layers were not kept: those of no rows, which the model completes when it needs them.
    layers = [name for name in held if name.startswith("layers.") and name.endswith(".inducing_inputs")]
    for index in range(len(layers) - 1):
        shape = 1, 0, held["layers.0.inducing_inputs"].shape[1]
        upgraded[f"latents.{index}"] = torch.zeros(shape, dtype=torch.float32, device="cpu")
    return config, tensors | {"dynamics": upgraded}


def _by_noun(config: Config, tensors: Tensors, schema: int) -> tuple[Config, Tensors]:
    """Schemas 1 to 4 as 5: a part for each noun.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the contents are not those of the schema.
    """
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
