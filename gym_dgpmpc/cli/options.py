"""The options of `dgpmpc train` that set the agent's arguments, made from the settings of the agent's parts.

An option is called as its setting is, with dashes, and without "num-" too where the name begins so: ``--num-layers``,
``--layers``. It is None unless it is given, so that the environment's preset or the part's own default takes effect.
Reading the settings imports PyTorch; `cli/__init__.py` does so only when `dgpmpc train` runs.
"""

import inspect
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import typer

from gym_dgpmpc.agents import (
    DeepPILCOAgent,
    DGPMPCAgent,
    DynaAgent,
    MCPILCOAgent,
    MixtureMPCAgent,
    MPCAgent,
    PILCOAgent,
    presets,
)
from gym_dgpmpc.agents.composition import controller_settings, model_settings
from gym_dgpmpc.cli.request import DEFAULT_AGENT
from gym_dgpmpc.cli.train import RUN
from gym_dgpmpc.planning.registry import PLANNERS, planner_factory
from gym_dgpmpc.settings import Setting, settings_of
from gym_dgpmpc.tasks.functions import LEARNED, NEVER


class Trained(NamedTuple):
    """A class of agents that the command line trains, and its presets by the environment's id."""

    agent_class: type[MPCAgent]
    settings_for: Callable[[str], Mapping[str, Any]]


AGENTS: dict[str, Trained] = {
    "dgp-mpc": Trained(DGPMPCAgent, presets.settings_for),
    "dyna": Trained(DynaAgent, presets.settings_for),
    "mixture": Trained(MixtureMPCAgent, presets.mixture_settings_for),
    "mc-pilco": Trained(MCPILCOAgent, presets.policy_search_settings_for),
    "deep-pilco": Trained(DeepPILCOAgent, presets.policy_search_settings_for),
    "pilco": Trained(PILCOAgent, presets.policy_search_settings_for),
}
"""By name. Their settings of the same name, which are one option, mean the same."""

SET_BY_THE_RUN = {"seed", "verbose", "tensorboard_log", "stats_window_size", "observation_spec"}
"""Settings of the agent that are not options: the run has them, or they are not plain values."""

AGENT_TEXT = (
    "What is trained: a planner with a deep Gaussian process; one that acts by a policy from its worlds; a planner "
    "with a mixture of models; or a policy of few parameters, searched in sampled worlds or by exact moments. "
    "`--agent NAME --help` shows the options of each."
)
PLANNER_TEXT = "Planner, which optimises action sequences."
SOURCE_TEXTS = {
    "reward_fn": "Let the model learn the reward, even where it is known.",
    "terminated_fn": "Let the model learn when an episode ends, even where it is known; or plan as if none did.",
}


def agent_asked_for(args: Sequence[str]) -> str:
    """The agent that a command line names, or the default; what is wrong about it is said when it is parsed."""
    name = value_given("--agent", args)
    return name if name in AGENTS else DEFAULT_AGENT


def value_given(option: str, args: Sequence[str]) -> str | None:
    """The last value of an option in a command line, as "--option VALUE" or "--option=VALUE"; None without one."""
    joined_to = f"{option}="
    values = [
        each.removeprefix(joined_to) if each.startswith(joined_to) else after
        for each, after in pairwise([*args, ""])
        if each == option or each.startswith(joined_to)
    ]
    return values[-1] if values else None


def with_settings(command: Callable[..., None], agent: str = DEFAULT_AGENT) -> Callable[..., None]:
    """The command with an option for each setting; their values are passed to it by name, as ``asked``.

    Args:
        command: the command.
        agent: the one whose options its help shows.
    """

    def with_options(**given: Any) -> None:
        asked = {name: _plain_value(given.pop(name)) for name in names}
        command(**given, asked=asked)

    own = [p for p in inspect.signature(command).parameters.values() if p.name != "asked"]
    options = list(_options(agent))
    names = [option.name for option in options]
    with_options.__doc__ = command.__doc__
    with_options.__name__ = command.__name__
    with_options.__signature__ = inspect.Signature([*own, *options])  # type: ignore[attr-defined]
    with_options.__annotations__ = {p.name: p.annotation for p in (*own, *options)}
    return with_options


def _options(agent: str) -> Iterable[inspect.Parameter]:
    seen: set[str] = set()
    made_of = AGENTS[agent].agent_class.made_of()
    shown = {*model_settings(made_of), *controller_settings(made_of)}
    own = MPCAgent.own_settings()
    # The one whose help is shown comes first, so that the defaults are its own.
    agents = sorted(AGENTS.items(), key=lambda named: named[0] != agent)
    groups = [(f"Model of {name}", model_settings(each.agent_class.made_of())) for name, each in agents]
    groups += [(f"Policy of {name}", controller_settings(each.agent_class.made_of())) for name, each in agents]
    groups += [("Planner", {n: s for n, s in own.items() if n in _PLANNING})]
    groups += [("Planner", settings_of(planner_factory(name))) for name in PLANNERS]
    groups += [("Training", {n: s for n, s in own.items() if n not in _PLANNING})]
    yield _option("agent", _choice("agent", AGENTS), AGENT_TEXT, DEFAULT_AGENT, RUN)
    yield _option(
        "planner", _choice("planner", tuple(PLANNERS)), PLANNER_TEXT, _or_the_presets("planner", ["cem"]), "Planner"
    )
    for panel, settings in groups:
        for setting in settings.values():
            kind = _option_type(setting)
            if setting.name not in seen | SET_BY_THE_RUN and kind is not None:
                seen.add(setting.name)
                hidden = setting.name not in shown and panel.startswith(("Model", "Policy"))
                yield _option(setting.name, kind, setting.text, _default_text(setting), panel, hidden=hidden)
    for name, text in SOURCE_TEXTS.items():
        choices = (LEARNED, NEVER) if name == "terminated_fn" else (LEARNED,)
        yield _option(name, _choice(name, choices), text, "what is known; else learned", "Task")


_PLANNING = ("num_particles", "actions_per_plan", "risk", "risk_aversion", "cvar_share", "time_budget")


def _option(
    name: str, kind: Any, text: str, default: str | bool, panel: str, *, hidden: bool = False
) -> inspect.Parameter:
    dashed = name.replace("_", "-")
    names = [f"--{dashed}", *([f"--{dashed.removeprefix('num-')}"] if dashed.startswith("num-") else [])]
    if kind is bool:
        names = [f"--{dashed}/--no-{dashed}"]
    text = f"{text[:1].upper()}{text[1:]}".replace("``", "")
    option = typer.Option(*names, help=text, show_default=default, rich_help_panel=panel, hidden=hidden)
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind | None, option]
    )


def _option_type(setting: Setting) -> Any:
    """The type of an option, or None if the setting is not a plain value; one of several is given once for each."""
    annotation = setting.annotation
    if get_origin(annotation) in (Union, types.UnionType):
        kinds = [each for each in get_args(annotation) if each is not type(None)]
        annotation = kinds[0] if len(kinds) == 1 else None
    if get_origin(annotation) is Literal:
        return _choice(setting.name, get_args(annotation))
    if get_origin(annotation) is Sequence and get_origin(get_args(annotation)[0]) is Literal:
        return list[_choice(setting.name, get_args(get_args(annotation)[0]))]  # type: ignore[misc]
    return annotation if annotation in (int, float, bool, str) else None


def _choice(name: str, choices: Iterable[str]) -> Any:
    return Enum(name, {choice: choice for choice in choices}, type=str)


def _default_text(setting: Setting) -> str | bool:
    """The text of the default; False where the option's own text says it."""
    texts = [] if setting.default is None else [str(setting.default)]
    return _or_the_presets(setting.name, texts) or False


def _or_the_presets(name: str, texts: list[str]) -> str:
    """A default with a word of presets, if any task has one for this setting."""
    return " or ".join([*texts, *(["the preset's for ENV_ID"] if name in _of_presets() else [])])


@cache
def _of_presets() -> set[str]:
    """Names of settings that the preset of some task has."""
    env_ids = {env_id for table in (*presets.OF_A_TASK, presets.NETWORKS) for env_id in table}
    return {name for each in AGENTS.values() for env_id in env_ids for name in each.settings_for(env_id)}


def _plain_value(value: Any) -> Any:
    if isinstance(value, list):  # empty if the option is not given
        return tuple(map(_plain_value, value)) or None
    return value.value if isinstance(value, Enum) else value
