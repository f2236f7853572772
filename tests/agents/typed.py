"""Writes `gym_dgpmpc/agents/typed.pyi`, from which type checkers and editors know the named agents' arguments.

The agents' constructors are composed of their parts' settings when Python runs, which no type checker sees. What is
written here is made of the same settings; `test_typed.py` holds that nothing has changed since.

    python -m tests.agents.typed
"""

import inspect
import json
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ForwardRef, Literal, Union, get_args, get_origin

import gym_dgpmpc.agents
from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.planning.registry import PLANNERS
from gym_dgpmpc.settings import Setting, settings_of

STUB = Path(gym_dgpmpc.agents.__file__).with_name("typed.pyi")
AGENTS = [getattr(gym_dgpmpc.agents, name) for name in sorted(gym_dgpmpc.agents.__all__) if name != "MPCAgent"]
HEAD = '''"""The named agents as type checkers see them, with every argument; nothing here runs.

Written by `python -m tests.agents.typed` from the settings of the agents' parts: change these, and write it anew.
"""

'''
IN_ORDER = ("policy", "env")
"""Arguments that may stand first, without their names; see `signature.called_in_order`."""


def generated() -> str:
    """The text of the file."""
    modules: set[tuple[str, str]] = set()
    classes = ["\n".join(_class(agent, modules)) for agent in AGENTS]
    imported: dict[str, list[str]] = {}
    for module, name in sorted(modules):
        imported.setdefault(module, []).append(name)
    imports = "\n".join(f"from {module} import {', '.join(names)}" for module, names in imported.items())
    return "\n\n".join([HEAD + imports, *classes]) + "\n"


def _class(agent: type[MPCAgent], modules: set[tuple[str, str]]) -> Iterator[str]:
    base = agent.__bases__[-1]
    modules.add((base.__module__, base.__name__))
    yield f"class {agent.__name__}Base({base.__name__}):"
    yield "    def __init__("
    yield "        self,"
    parameters = {**inspect.signature(agent).parameters, **_of_other_planners(agent)}
    first = dict.fromkeys(_text(parameters[name].annotation, modules) for name in IN_ORDER)
    yield f"        *args: {' | '.join(dict.fromkeys(' | '.join(first).split(' | ')))},"
    for parameter in parameters.values():
        yield f"        {parameter.name}: {_text(parameter.annotation, modules)} = {_default(parameter.default)},"
    yield "    ) -> None: ..."
    for name, value in vars(agent).items():
        if isinstance(value, property) and name in parameters:
            yield "    @property"
            yield f"    def {name}(self) -> {_text(parameters[name].annotation, modules)}: ..."


def _of_other_planners(agent: type[MPCAgent]) -> dict[str, inspect.Parameter]:
    """Settings that the agent has with a planner of another name; `inspect.signature` shows those of the first."""
    own = {**agent.own_settings(), **agent.part_settings("cem")}
    found: dict[str, Setting] = {}
    for factory in PLANNERS.values():
        for name, setting in settings_of(factory).items():
            if name in own or name in found:
                assert setting.annotation == {**own, **found}[name].annotation, f"{name} has two types"
            else:
                found[name] = setting
    return {name: setting.parameter(setting.default) for name, setting in found.items()}


def _text(annotation: Any, modules: set[tuple[str, str]]) -> str:
    """An annotation as source, with what has to be imported for it."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if annotation is None or annotation is type(None):
        return "None"
    if annotation is Any:
        modules.add(("typing", "Any"))
        return "Any"
    if origin in (Union, types.UnionType):
        return " | ".join(_text(each, modules) for each in arguments)
    if origin is Literal:
        modules.add(("typing", "Literal"))
        return f"Literal[{', '.join(map(json.dumps, arguments))}]"
    if origin is Callable:
        modules.add(("collections.abc", "Callable"))
        taken, returned = arguments
        inside = "..." if taken is ... else f"[{', '.join(_text(each, modules) for each in taken)}]"
        return f"Callable[{inside}, {_text(returned, modules)}]"
    if isinstance(annotation, ForwardRef):  # of Stable-Baselines3's GymEnv
        assert annotation.__forward_arg__ == "VecEnv"
        modules.add(("stable_baselines3.common.vec_env", "VecEnv"))
        return "VecEnv"
    made = annotation if origin is None else origin
    if made.__module__ != "builtins":
        modules.add((made.__module__, made.__name__))
    inside = f"[{', '.join(_text(each, modules) for each in arguments)}]" if arguments else ""
    return f"{made.__name__}{inside}"


def _default(value: Any) -> str:
    return json.dumps(value) if isinstance(value, str) else repr(value)


if __name__ == "__main__":
    STUB.write_text(generated())
