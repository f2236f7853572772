"""Worlds drawn from a dynamics model, side by side, as a `VecEnv` of Stable-Baselines3.

Any of its algorithms trains in them unchanged. `policies.py` does so for an agent; what the worlds are drawn from, and
their rewards, are the agent's own.
"""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Bool, Float
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from torch import Tensor

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.imagination.beginnings import Beginnings, Plausible, StartFunction, StartName, recorded_beginnings
from gym_dgpmpc.randomness import fresh_seed
from gym_dgpmpc.tasks.dict_observations import layout_of, original_space, unflattened
from gym_dgpmpc.tasks.environment import flat_size, time_limit
from gym_dgpmpc.tasks.task import Task
from gym_dgpmpc.types import DynamicsModel, RewardFn, TerminatedFn, TransitionSampler

LONGEST = 200
"""Steps of an imagined episode, unless the task's own are fewer: the further it goes, the less a model knows."""


@runtime_checkable
class Imagining(Protocol):
    """What is asked of an agent in whose worlds to live."""

    @property
    def task(self) -> Task: ...
    @property
    def dynamics(self) -> DynamicsModel: ...
    @property
    def store(self) -> TransitionStore: ...
    @property
    def env(self) -> VecEnv | None: ...
    @property
    def observation_space(self) -> spaces.Box: ...
    @property
    def action_space(self) -> spaces.Box: ...
    @property
    def device(self) -> torch.device: ...
    @property
    def seed(self) -> int: ...
    @property
    def is_fitted(self) -> bool: ...


class ImaginedVecEnv(VecEnv):
    """n worlds of a dynamics model, one episode running in each; `of` makes those of an agent.

    All worlds take a step in one batched call. Together they last ``episode_steps`` steps, and are then drawn anew. An
    episode that ends before is followed by another one in the same world, so that worlds in which episodes are short
    are not lived in more than others; the last one is truncated when the worlds end.

    A state that leaves the plausible range, or is not finite, terminates its episode, which earns ``least_reward`` for
    that step and each that is left: nobody knows what is there, so it is taken for the worst that is known, and no
    value is asked of it. (With truncation a policy could collect what lies beyond the data for ever.) The final
    observation is the last plausible one; infos say so in "implausible".

    Args:
        dynamics: a trained model, of vectors of S_all numbers that begin with the observation's S.
        reward_fn: of predicted vectors and actions.
        beginnings: the observations that episodes begin at.
        observation_space: a Box of S numbers, or a Dict of vectors that has S together.
        action_space: a bounded Box; actions beyond the bounds are clipped.
        terminated_fn: of predicted vectors; None: episodes are truncated only.
        size: S_all; None: S.
        num_worlds: n.
        episode_steps: steps of the longest episode.
        plausible: the range of plausible observations; None: none is implausible that is finite.
        least_reward: what a step earns in the unknown.
        seed: of worlds and beginnings; None draws one.
        device: of the model.
        dtype: of the states, float32 or float64.

    Raises:
        ValueError, TypeError: ``num_worlds`` or ``episode_steps`` is not a positive whole number.
    """

    def __init__(
        self,
        dynamics: DynamicsModel,
        reward_fn: RewardFn,
        beginnings: Beginnings,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        *,
        terminated_fn: TerminatedFn | None = None,
        size: int | None = None,
        num_worlds: int = 20,
        episode_steps: int = LONGEST,
        plausible: Plausible | None = None,
        least_reward: float = 0.0,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ):
        check_counts(num_worlds=num_worlds, episode_steps=episode_steps)
        self.render_mode = None
        super().__init__(num_worlds, observation_space, action_space)
        self.dynamics, self.reward_fn, self.terminated_fn = dynamics, reward_fn, terminated_fn
        self.episode_steps, self.least_reward = episode_steps, least_reward
        self._beginnings = beginnings
        is_dict = isinstance(observation_space, spaces.Dict)
        parts = layout_of(observation_space).values() if is_dict else ()
        self.observation_size = max(part.stop for part in parts) if is_dict else flat_size(observation_space)
        self._size = self.observation_size if size is None else size
        self._low, self._high = (
            torch.as_tensor(bound, dtype=dtype, device=device).flatten()
            for bound in (action_space.low, action_space.high)
        )
        self._plausible = None if plausible is None else plausible.to(self._low)
        self.generator = torch.Generator(device).manual_seed(fresh_seed() if seed is None else seed)
        self._sampler: TransitionSampler | None = None
        self._step = 0  # of the worlds
        self._states = self._low.new_zeros(num_worlds, self._size)
        self._actions = self._low.new_zeros(num_worlds, len(self._low))
        self._returns, self._lengths = np.zeros(num_worlds), np.zeros(num_worlds, dtype=int)

    @classmethod
    def of(
        cls,
        agent: Imagining,
        num_worlds: int = 20,
        *,
        episode_steps: int | None = None,
        starts: StartName | StartFunction = "mixed",
        seed: int | None = None,
        is_limited: bool = True,
    ) -> "ImaginedVecEnv":
        """The worlds of an agent's model, with the rewards and terminations that it plans for.

        Args:
            agent: one that has learned.
            num_worlds: n.
            episode_steps: steps of an episode; None: the environment's time limit, or `LONGEST` if that is less.
            starts: "starts", the first observations of recorded episodes; "states", any recorded observations;
                "mixed", each with equal chances; or a function (n, NumPy generator) -> observations [n, S].
            seed: of worlds and beginnings; None draws one.
            is_limited: whether episodes end where states leave the plausible range.

        Raises:
            ValueError: the agent has not learned yet, or an argument is out of its range.
            UnknownRewardError: it was loaded without an environment and without a reward function.
        """
        if not agent.is_fitted:
            raise ValueError("the agent has not learned yet, so there are no worlds: call learn first")
        task = agent.task
        if episode_steps is None:
            limit = time_limit(agent.env)
            episode_steps = LONGEST if limit is None else min(limit, LONGEST)
        reward_fn, terminated_fn = task.planned[:2]
        assert reward_fn is not None
        known = task.transitions(agent.store)
        return cls(
            agent.dynamics,
            reward_fn,
            recorded_beginnings(agent.store, starts),
            original_space(agent.env, agent.observation_space),
            agent.action_space,
            terminated_fn=terminated_fn,
            size=task.modelled.size,
            num_worlds=num_worlds,
            episode_steps=episode_steps,
            plausible=Plausible.of(agent.store, task.modelled.observation_spec) if is_limited else None,
            least_reward=float(reward_fn(known.observation, known.action, known.next_observation).min()),
            seed=seed,
            device=agent.device,
            dtype=torch.float64 if task.is_exact else torch.float32,
        )

    def reset(self) -> VecEnvObs:
        """Draw all worlds anew, and begin an episode in each; after `seed`, those of that seed."""
        if self._seeds[0] is not None:
            self.generator.manual_seed(self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self._draw_worlds()
        self._begin(np.ones(self.num_envs, dtype=bool))
        return self._observed(self._states)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions, [n, *A], for `step_wait`."""
        flat = np.asarray(actions).reshape(self.num_envs, -1)
        self._actions = torch.from_numpy(flat).to(self._low).clamp(self._low, self._high)

    @torch.no_grad()
    def step_wait(self) -> VecEnvStepReturn:
        """One step in every world; where an episode ended, the observation is the next one's first.

        Raises:
            RuntimeError: `reset` was not called before.
        """
        if self._sampler is None:
            raise RuntimeError("call reset before the first step: no worlds are drawn yet")
        before = self._states
        after = self._sampler(before.unsqueeze(1), self._actions.unsqueeze(1), self._step).squeeze(1)
        left = self.left(after)
        after = torch.where(left.unsqueeze(-1), before, after)
        reward = self.reward_fn(before, self._actions, after).to(before)
        left |= ~reward.isfinite()
        terminated = left if self.terminated_fn is None else left | self.terminated_fn(after)
        rewards, lost, ended = (tensor.cpu().numpy() for tensor in (reward, left, terminated))
        rewards = np.where(lost, self.least_reward * (self.episode_steps - self._lengths), rewards)
        self._step += 1
        self._returns += rewards
        self._lengths += 1
        dones = ended | (self._step >= self.episode_steps)
        last = self._observed(after)
        infos = [self._info(last, i, bool(ended[i]), bool(lost[i])) if dones[i] else {} for i in range(self.num_envs)]
        self._states = after
        if self._step >= self.episode_steps:
            self._draw_worlds()
        if dones.any():
            self._begin(dones)
        return self._observed(self._states), rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Forget the worlds."""
        self._sampler = None

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The attribute of this object, once for each world: they share it."""
        return [getattr(self, attr_name)] * len(self._chosen(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of this object, which all worlds share."""
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list:
        """Call a method of this object, once for each world."""
        return [getattr(self, method_name)(*method_args, **method_kwargs) for _ in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """No world is in a wrapper; the infos have all the same what `Monitor` puts there."""
        return [False] * len(self._chosen(indices))

    def _chosen(self, indices: VecEnvIndices) -> Sequence[int]:
        return list(self._get_indices(indices))

    def _draw_worlds(self) -> None:
        with torch.no_grad():
            self._sampler = self.dynamics.draw(self.num_envs, self.episode_steps, self.generator)
        self._step = 0

    def _begin(self, where: np.ndarray) -> None:
        """Begin an episode in these worlds."""
        states = self._states.clone()
        states[torch.from_numpy(where).to(states.device)] = self.starts(int(where.sum()))
        self._states = states
        self._returns[where], self._lengths[where] = 0.0, 0

    def starts(self, count: int) -> Float[Tensor, "count S_all"]:
        """States at which episodes begin."""
        observation = self._beginnings(count, self.generator).to(self._low)
        return torch.nn.functional.pad(observation, (0, self._size - self.observation_size))

    def unscaled(self, action: Float[Tensor, "*b A"]) -> Float[Tensor, "*b A"]:
        """Actions within their bounds, from such in [-1, 1]."""
        return self._low + 0.5 * (action.to(self._low) + 1.0) * (self._high - self._low)

    def left(self, after: Float[Tensor, "*b S_all"]) -> Bool[Tensor, "*b"]:
        """Which states are none that an episode can go on from."""
        left = ~after.isfinite().all(-1)
        if self._plausible is not None:
            left = left | self._plausible.left(after[..., : self.observation_size])
        return left

    def _observed(self, states: Float[Tensor, "n S_all"]) -> VecEnvObs:
        """What the environment would show of the states."""
        return unflattened(states[:, : self.observation_size].cpu().numpy(), self.observation_space)

    def _info(self, last: VecEnvObs, index: int, terminated: bool, lost: bool) -> dict[str, Any]:
        """What Stable-Baselines3 is to know of an episode that has ended."""
        final = {key: part[index] for key, part in last.items()} if isinstance(last, dict) else last[index]
        return {
            "terminal_observation": final,
            "TimeLimit.truncated": not terminated,
            "implausible": lost,
            "episode": {"r": float(self._returns[index]), "l": int(self._lengths[index]), "t": 0.0},
        }
