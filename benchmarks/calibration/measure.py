"""One model on one seed of a task: trained on 1, 2 and 4 of its episodes, tested on others after each.

As in learning, a model goes on from its last training. Tested is the episode that came next in the learning run ("on
the policy"), and two of random actions that were never learned from ("off").
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from benchmarks.calibration.episodes import DATA, SMOOTH, TASKS, WHITE, load, observation_spec, spread
from benchmarks.calibration.forecasts import forecast
from benchmarks.calibration.models import Make
from gym_dgpmpc.agents.presets import DEEP_GP, NETWORKS, for_mixture
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.dynamics.ensemble.model import EnsembleDynamics
from gym_dgpmpc.dynamics.mixture.model import MixtureDynamics
from gym_dgpmpc.dynamics.scores import scores

HORIZONS = {"cartpole": (1, 10, 20), "pendulum": (1, 10, 20), "reacher": (1, 10, 20), "cheetah": (1, 10, 20, 40)}

TESTED_AFTER = (1, 2, 4)


def measure(
    make: Make, task: str, seed: int, episodes: tuple[int, ...] = TESTED_AFTER, data: Path = DATA, **settings: Any
) -> list[dict[str, Any]]:
    """A row of scores for each number of episodes, test and horizon."""
    recording, spec, unit = load(task, seed, data), observation_spec(task), spread(task, data)
    sizes = recording.observation.shape[-1], recording.action.shape[-1]
    settings = {**_presets(make, TASKS[task]), **settings}
    model, generator = make(*sizes, spec, **settings), torch.Generator().manual_seed(seed)
    predicted = model.encoder.predicted
    rows: list[dict[str, Any]] = []
    seconds = 0.0
    for count in range(1, max(episodes) + 1):
        started = time.process_time()
        metrics = model.fit(recording.transitions(range(count)), generator)
        seconds += time.process_time() - started
        if count not in episodes:
            continue
        for name, tested in (("on", [count]), ("off", [WHITE, SMOOTH])):
            played = [recording.transitions([episode]) for episode in tested]
            for horizon, (particles, truth) in forecast(model, played, HORIZONS[task], generator).items():
                about = {"task": task, "seed": seed, "episodes": count, "test": name, "horizon": horizon}
                rows.append(
                    about
                    | scores((particles / unit)[..., predicted], (truth / unit)[..., predicted])
                    | {"fit_seconds": seconds, "noise_std": float(metrics.get("noise_std", float("nan")))}
                )
    return rows


def _presets(make: Make, env_id: str) -> Mapping[str, Any]:
    """What is set for the model on a task."""
    of_deep_gp: Mapping[str, Any] = DEEP_GP.get(env_id, {})
    of_ensemble: Mapping[str, Any] = NETWORKS.get(env_id, {})
    of_class: dict[Any, Mapping[str, Any]] = {
        DeepGPDynamics: of_deep_gp,
        EnsembleDynamics: of_ensemble,
        MixtureDynamics: for_mixture(of_deep_gp, of_ensemble),
    }
    return of_class.get(getattr(make, "func", None), {})
