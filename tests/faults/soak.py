"""Many episodes in one process: memory and time per step must not grow, but for the data that are kept."""

import gc
import os
import time
from pathlib import Path

import gymnasium
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from gym_dgpmpc import DGPMPCAgent
from tests.faults.kills import TINY

EPISODE_STEPS = 5
ROW_BYTES = 200
"""A generous bound on what one step may keep: its row in the store, a copy while that grows, Monitor's sums."""
ALLOWED_GROWTH = 12 << 20
ALLOWED_SLOWDOWN = 1.5


class Measure(BaseCallback):
    """Memory, and seconds of the processor per step, after each episode."""

    def __init__(self):
        super().__init__()
        self.memory, self.seconds, self._before = [], [], time.process_time()

    def _on_step(self):
        if self.locals["dones"][0]:
            if len(self.memory) % 50 == 0:
                gc.collect()
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self.memory.append(pages * os.sysconf("SC_PAGE_SIZE"))
            now = time.process_time()
            self.seconds.append((now - self._before) / EPISODE_STEPS)
            self._before = now
        return True


def run_soak(folder, num_episodes):
    """Learn for so many episodes, with checkpoints and logs: (what was measured, what was wrong)."""
    measured = Measure()
    env = gymnasium.make("NoisyPush-v0", max_episode_steps=EPISODE_STEPS)
    agent = DGPMPCAgent(env, seed=0, tensorboard_log=str(Path(folder) / "soak" / "logs"), **TINY)
    agent.learn(num_episodes * EPISODE_STEPS, measured, run_folder=Path(folder) / "soak")
    quarter = num_episodes // 4
    memory, seconds = np.array(measured.memory), np.array(measured.seconds)
    grown = int(memory[-1] - memory[quarter - 1])
    allowed = ALLOWED_GROWTH + ROW_BYTES * EPISODE_STEPS * (num_episodes - quarter)
    early, late = np.median(seconds[quarter : 2 * quarter]), np.median(seconds[-quarter:])
    found = {
        "episodes": len(memory),
        "memory at a quarter, MB": round(memory[quarter - 1] / 1e6, 1),
        "memory at the end, MB": round(memory[-1] / 1e6, 1),
        "CPU ms per step, second quarter": round(1e3 * early, 1),
        "CPU ms per step, last quarter": round(1e3 * late, 1),
    }
    wrong = []
    if len(memory) != num_episodes:
        wrong.append(f"{len(memory)} episodes instead of {num_episodes}")
    if grown > allowed:
        wrong.append(f"memory grew by {grown >> 20} MB")
    if late > ALLOWED_SLOWDOWN * early:
        wrong.append(f"a step took {late / early:.2f} times as long in the end")
    return found, wrong
