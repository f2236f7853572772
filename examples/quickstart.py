"""Learn the modified cart-pole, evaluate, save and load: the script of docs/using.md with a few knobs.

python examples/quickstart.py                 # ten episodes, two to three minutes on one core
python examples/quickstart.py --steps 600     # the random episode and two planned ones
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import gym_dgpmpc  # noqa: F401  # registers the environments
from gym_dgpmpc import DGPMPCAgent, settings_for


def main(steps: int = 2_000, folder: Path = Path("runs/quickstart"), **settings: Any) -> float:
    """Train for ``steps`` environment steps and return the mean return of two evaluation episodes."""
    env = gym.make("ModCartPole-v0")
    # What is known to be good for the task; for one of your own leave it out, and begin with the agent's defaults.
    arguments = {**settings_for("ModCartPole-v0"), "num_layers": 2, "seed": 0, "verbose": 1, **settings}
    agent = DGPMPCAgent(env, tensorboard_log=str(folder), **arguments)
    agent.learn(total_timesteps=steps)

    # Without learning: the agent's own random numbers are not advanced, and nothing is stored.
    mean, spread = evaluate_policy(agent, Monitor(gym.make("ModCartPole-v0")), n_eval_episodes=2)
    print(f"return over two episodes: {mean:.1f} +- {spread:.1f}")

    # The file holds all posterior samples, the data and the counters; a loaded agent acts as the saved one.
    agent.save(folder / "agent")
    agent = DGPMPCAgent.load(folder / "agent", env=env)
    observation, _ = env.reset(seed=1)
    action, _ = agent.predict(observation, deterministic=True)
    print(f"first action at {observation.round(2)}: {action.round(2)}")
    env.close()
    return float(mean)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2_000, help="environment steps, the random ones included")
    parser.add_argument("--folder", type=Path, default=Path("runs/quickstart"), help="where logs and agent go")
    given = parser.parse_args()
    main(given.steps, given.folder)
