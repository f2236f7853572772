"""Playing an environment, and reading the tables of its documentation."""

import inspect

import numpy as np


def play(env, actions, seed):
    """Observations (T+1, S), rewards and infos of one episode."""
    observations, rewards, infos = [env.reset(seed=seed)[0]], [], []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        assert type(reward) is float and type(terminated) is bool and type(truncated) is bool
        assert not terminated
        observations.append(observation)
        rewards.append(reward)
        infos.append(info)
    return np.array(observations), np.array(rewards), infos


def uniform_actions(space, num_steps, seed, stretch=1.0):
    """Actions (T, A), uniform between the bounds of the space or of what ``stretch`` makes of them."""
    rng = np.random.default_rng(seed)
    return rng.uniform(stretch * space.low, stretch * space.high, (num_steps, *space.shape)).astype(np.float32)


def section(cls, title):
    return inspect.getdoc(cls).split(f"## {title}\n")[1].split("\n## ")[0]


def table(cls, title):
    """The rows of a section's table, header and rule left out, each a list of cells."""
    return rows_of(section(cls, title))


def rows_of(text):
    rows = [line for line in text.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
