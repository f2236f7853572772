"""What matters for the first planned episode: `python -m benchmarks.ablation`.

Every variant learns from the same episode of random actions and then plans the first steps of an episode, so that a
variant costs a few minutes. Beside the return it says what the plans expected and what was obtained (a planner that
exploits errors of its model expects more), and how well the model predicts H steps ahead under smoother random actions.
Writes `ablation.md` and `ablation.json`; what is in the latter already, with the same settings, is not done again.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import torch
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks import RESULTS
from benchmarks.calibration.episodes import random_episode
from benchmarks.calibration.scores import forecast, scores
from benchmarks.rows import Row, measure_missing
from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.agents.presets import PAPER

VARIANTS: dict[str, dict[str, Any]] = {
    "default (L = 2)": {},
    "L = 1": {"num_layers": 1},
    "L = 1, RBF": {"num_layers": 1, "kernel": "rbf"},
    "SG-HMC alone": {"gibbs_every": 0, "sample_spacing": 50},
    "no re-sampling within the episode": {"resample_steps": 0},
    "one function per particle and plan": {"refresh": "plan"},
    "1 particle": {"num_particles": 1},
    "horizon 20": {"horizon": 20},
    "trained for a quarter as long": {"first_training_iterations": 1000},
}
"""Arguments of `DGPMPCAgent` that differ from the paper's settings for the task."""

SETTINGS = argparse.ArgumentParser(add_help=False)
SETTINGS.add_argument(
    "--env", dest="environment", metavar="ENV_ID", default="RiskSensitiveHalfCheetah-v0", help="id of the environment"
)
SETTINGS.add_argument("--steps", type=int, default=200, help="planned steps")

HORIZONS, TEST_SEEDS = (1, 10, 20, 40), range(5000, 5003)


class _OneEpisode(BaseCallback):
    """Keeps what the agent logs about an episode, and stops before it is learned from."""

    def _on_step(self) -> bool:
        return not self.locals["dones"][0]

    def _on_rollout_end(self) -> None:
        self.values = dict(self.logger.name_to_value)


def measure(wanted: Row) -> Row:
    """One model on one random episode, and the first steps it plans."""
    env_id, steps, variant, seed = (wanted[name] for name in ("environment", "steps", "variant", "seed"))
    source = gymnasium.make(env_id)
    data = random_episode(source, seed, 0.0)
    env = gymnasium.make(env_id, max_episode_steps=steps)
    agent = DGPMPCAgent(env, seed=seed, **{**PAPER.get(env_id, {}), **VARIANTS[variant]})
    assert agent.task.functions.reward_fn is not None
    columns = {name: value.numpy() for name, value in data._asdict().items()}
    agent.add_transitions({**columns, "reward": agent.task.functions.reward_fn(*data).numpy()})
    agent.learn(0)
    row: Row = {}
    tests = [random_episode(source, test_seed, 0.8) for test_seed in TEST_SEEDS]
    spread = torch.cat([test.next_observation for test in tests]).std(0)
    by_horizon = forecast(agent.dynamics, tests, HORIZONS, torch.Generator().manual_seed(seed))
    for horizon, (particles, truth) in by_horizon.items():
        # What never changes has no spread, and nothing to predict.
        found = scores((particles / spread)[..., spread > 0], (truth / spread)[..., spread > 0])
        row |= {f"error_{horizon}": found["rmse"], f"coverage_90_{horizon}": found["coverage_90"]}
    started, kept = time.process_time(), _OneEpisode()
    agent.learn(steps, kept, log_interval=sys.maxsize)
    row["return"] = kept.values["rollout/ep_return"]
    for name in ("predicted", "obtained"):
        row[name] = kept.values[f"planner/{name}_reward_per_step"]
    return row | {"planning_cpu_seconds": time.process_time() - started}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ablation", description=__doc__, parents=[SETTINGS])
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS), metavar="VARIANT")
    parser.add_argument("--seeds", nargs="+", type=int, default=[100, 101])
    parser.add_argument("--results", type=Path, default=RESULTS / "ablation")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = {"environment": arguments.environment, "steps": arguments.steps}
    # Seeds outermost, so that an interrupted benchmark has every variant with some seeds.
    wanted = [
        settings | {"variant": variant, "seed": seed} for seed in arguments.seeds for variant in arguments.variants
    ]
    print(measure_missing("ablation", arguments.results, wanted, measure, SETTINGS))


if __name__ == "__main__":
    main()
