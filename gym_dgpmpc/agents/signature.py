"""How an agent is called: Stable-Baselines3's order of arguments or none, and signatures made of the parts' settings.

`MPCAgent` uses it in its constructor, and for every named agent when its class is made.
"""

import inspect
import textwrap
from collections.abc import Iterable
from typing import Any

import gymnasium
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv

from gym_dgpmpc.settings import Setting, Settings, argument_texts, joined

PLAIN = (
    "num_particles",
    "actions_per_plan",
    "risk",
    "risk_aversion",
    "cvar_share",
    "learning_starts",
    "exploration",
    "exploration_hold",
    "exploration_beta",
    "train_freq",
    "observation_spec",
    "time_budget",
    "stats_window_size",
    "tensorboard_log",
    "verbose",
    "seed",
)
"""The arguments of every agent that are plain values, each an attribute too: what a file holds beside the parts'."""


NOT_PLAIN = ("planner", "reward_fn", "terminated_fn", "first_controller", "device")
"""The others, in a named agent's signature; an `MPCAgent` has ``dynamics`` besides."""

UNSET: Any = object()
"""In place of an environment that was not given, for None is one that is given."""

WIDTH = 116


def called_in_order(
    name: str, args: tuple[Any, ...], policy: Any, env: Any, dynamics: Any, planner: Any
) -> tuple[Any, Any, Any, Any]:
    """Policy, environment, dynamics and planner, of which the first ``args`` may be any beginning of that order.

    A policy may be left out: ``Agent(env)`` and ``Agent("MPCPolicy", env)`` are the same.

    Raises:
        TypeError: there is no environment, or an argument is given twice or is one too many.
    """
    rest = list(args)
    if rest and _is_policy(rest, env):
        policy = rest.pop(0)
    given = {"env": env, "dynamics": dynamics, "planner": planner}
    absent = {"env": UNSET, "dynamics": None, "planner": None}
    names = [each for each in given if not (each == "env" and env is not UNSET)]
    if len(rest) > len(names):
        raise TypeError(f"{name} takes policy, env, dynamics and planner in this order, got {len(args)} such arguments")
    for each, value in zip(names, rest, strict=False):
        if given[each] is not absent[each]:
            raise TypeError(f"{name} got {each} twice: as {value!r} and as {given[each]!r}")
        given[each] = value
    if given["env"] is UNSET:
        raise TypeError(f"{name} needs an environment, its id, or None: {name}(env, ...)")
    return policy, given["env"], given["dynamics"], given["planner"]


def _is_policy(args: list[Any], env: Any) -> bool:
    """Whether the first argument names a policy; an environment's id may stand there too."""
    first = args[0]
    if isinstance(first, type):
        return issubclass(first, BasePolicy)
    if not isinstance(first, str):
        return False
    is_env_next = len(args) > 1 and (args[1] is None or isinstance(args[1], str | gymnasium.Env | VecEnv))
    return env is not UNSET or is_env_next or (first.endswith("Policy") and len(args) == 1)


def composed_signature(agent: type, own: Settings, *of_parts: Settings) -> inspect.Signature:
    """What `inspect.signature` and `help` show of an agent: everything that it takes, with its defaults.

    Raises:
        ValueError: two parts have a setting of the same name.
    """
    base = inspect.signature(vars(_base(agent))["__init__"]).parameters
    keyword = inspect.Parameter.POSITIONAL_OR_KEYWORD
    parameters = [
        inspect.Parameter("policy", keyword, default="MPCPolicy", annotation=base["policy"].annotation),
        inspect.Parameter("env", keyword, default=None, annotation=base["env"].annotation),
    ]
    part_defaults = getattr(agent, "part_defaults", {})
    for setting in joined(*of_parts, own).values():
        parameters.append(setting.parameter(part_defaults.get(setting.name, setting.default)))
    parameters += [base[name].replace(default="cem" if name == "planner" else base[name].default) for name in NOT_PLAIN]
    if agent is _base(agent):  # takes any model, and any planner's settings
        parameters.insert(2, base["dynamics"].replace(kind=keyword))
        parameters.append(base["settings"])
    return inspect.Signature(parameters)


def composed_documentation(agent: type, own: Settings, *of_parts: Settings) -> str:
    """The docstring of a named agent: its own, with an ``Args:`` section made of its parts' texts."""
    texts = argument_texts(inspect.getdoc(_base(agent)) or "")
    common = [Setting(name, None, None, texts[name]) for name in ("env", *NOT_PLAIN[:-1], *own, NOT_PLAIN[-1])]
    policy = Setting("policy", None, None, texts["policy"].replace("MPCAgent", agent.__name__))
    described: Iterable[Setting] = [policy, common[0], *joined(*of_parts).values(), *common[1:]]
    lines = [line for setting in described for line in _entry(setting)]
    before, raises, after = inspect.cleandoc(agent.__doc__ or "").partition("\nRaises:")
    return "\n".join([before.rstrip(), "", "Args:", *lines, "", f"{raises.strip()}{after}"]).rstrip() + "\n"


def _entry(setting: Setting) -> list[str]:
    return textwrap.wrap(
        f"{setting.name}: {setting.text}", WIDTH, initial_indent=" " * 4, subsequent_indent=" " * 8,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def _base(agent: type) -> type:
    """`MPCAgent`, of which every named agent is a direct or indirect subclass."""
    return next(each for each in agent.__mro__ if each.__name__ == "MPCAgent")
