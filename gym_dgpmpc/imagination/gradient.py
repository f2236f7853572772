"""A policy by gradients through the model's worlds: its parameters climb the return that they cause.

The sampled functions of a pathwise draw are differentiable, so the derivative of a return by a policy's parameters
follows from the chain rule along the imagined path, without a critic and without noise in the actions: policy search
through sampled functions, as MC-PILCO has it with Gaussian processes (Amadio et al. 2022, "Model-Based Policy Search
Using Monte Carlo Gradient Estimation With Real Systems Application"). Paths are as short as a plan and begin wherever
the data or earlier paths have been, so that gradients stay small and the policy learns what a planner would do.
"""

import torch
from gymnasium import spaces
from jaxtyping import Float
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback
from torch import Tensor

from gym_dgpmpc.dynamics.gaussian_draws import match_moments
from gym_dgpmpc.errors import NotDifferentiableError
from gym_dgpmpc.imagination.worlds import ImaginedVecEnv

GOES_ON = 0.5
"""Share of the paths that begin where the last ones ended; the others begin where episodes do."""


class PolicyGradient(TD3):
    """An actor as TD3 has it, trained by gradients through an `ImaginedVecEnv`.

    It is saved as a TD3, whose critics were never trained: `TD3.load` gives a policy that acts.

    Args:
        policy, env, policy_kwargs, seed, device, verbose: as TD3's; ``env`` is an `ImaginedVecEnv` of vectors.
        horizon: steps of a path, H.
        num_paths: paths in each world.
        action_noise: standard deviation of the noise on a path's actions, in half-widths of their range: a policy that
            lives with it is not at a loss where the real world leads it somewhere else.
        learning_rate: of Adam at the beginning; it falls to a tenth, linearly.

    Raises:
        ValueError: the environment is another one, or has Dict observations.
    """

    def __init__(
        self,
        policy: str,
        env: ImaginedVecEnv,
        *,
        horizon: int = 30,
        num_paths: int = 8,
        action_noise: float = 0.2,
        learning_rate: float = 3e-3,
        policy_kwargs: dict | None = None,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        verbose: int = 0,
    ):
        if not isinstance(env.observation_space, spaces.Box):
            raise ValueError(
                f"the gradient climbs policies of observations that are vectors, got {env.observation_space}: take "
                "another algorithm, or put gymnasium.wrappers.FlattenObservation around the environment"
            )
        super().__init__(
            policy, env, learning_rate=learning_rate, buffer_size=1, policy_kwargs=policy_kwargs, seed=seed,
            device=device, verbose=verbose,
        )  # fmt: skip
        self._first_learning_rate = learning_rate
        self._paths = Paths(env, horizon, num_paths, action_noise, GOES_ON)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_paths", "_first_learning_rate"]

    def learn(self, total_timesteps: int, callback: BaseCallback | None = None, **others: object) -> "PolicyGradient":  # type: ignore[override]
        """Climb until so many imagined steps are taken; the callback is asked after each step of the optimiser.

        Raises:
            NotDifferentiableError: no gradient comes through the reward, or through the model's draws.
        """
        paths, actor = self._paths, self.actor
        _, callback = self._setup_learn(total_timesteps, callback)
        callback.on_training_start(locals(), globals())
        first = self._first_learning_rate
        optimiser = torch.optim.Adam(actor.parameters(), lr=first)
        while self.num_timesteps < total_timesteps:
            self.policy.set_training_mode(True)
            for group in optimiser.param_groups:
                group["lr"] = first * (1.0 - 0.9 * self.num_timesteps / total_timesteps)
            mean_reward = climb(paths, actor, optimiser)
            self.num_timesteps += paths.num_steps
            self.logger.record("train/mean_reward", mean_reward)
            if not callback.on_step():
                break
        callback.on_training_end()
        return self


def climb(paths: "Paths", actor: torch.nn.Module, optimiser: torch.optim.Optimizer) -> float:
    """One step of the optimiser up the mean reward of an actor's paths, which is returned as it was before.

    The gradient has length one: a policy that begins to succeed has gradients a thousand times smaller than one that
    fails, which Adam would remember for too long. Nothing is done where it is zero or not finite.

    Raises:
        NotDifferentiableError: no gradient comes through the reward, or through the model's draws.
    """
    mean_reward = paths.mean_reward(actor)
    if not mean_reward.requires_grad:
        raise NotDifferentiableError(
            "no gradient comes through the reward: it must follow from its arguments by differentiable operations of "
            "PyTorch. Take another algorithm, such as SAC, which needs none"
        )
    optimiser.zero_grad()
    (-mean_reward).backward()
    gradients = [parameter.grad for parameter in actor.parameters() if parameter.grad is not None]
    norm = torch.stack([gradient.norm() for gradient in gradients]).norm()
    if norm.isfinite() and norm > 0:
        for gradient in gradients:
            gradient.div_(norm)
        optimiser.step()
    return mean_reward.item()


class Paths:
    """Paths through worlds that are drawn anew for each step of the optimiser.

    Args:
        env: whose model, reward, termination, beginnings and plausible range are meant.
        horizon: H.
        num_paths: K, in each of its n worlds.
        action_noise: standard deviation of the noise on actions, of half their range.
        goes_on: share of the paths that begin where the last ones ended.
        matches_moments: after each step all states of paths that go on are replaced by draws from the Gaussian with
            their means and variances, as DeepPILCO does; gradients come through both. A reward sees the new next state
            beside a state that it does not follow from.
    """

    def __init__(
        self,
        env: ImaginedVecEnv,
        horizon: int,
        num_paths: int,
        action_noise: float,
        goes_on: float = GOES_ON,
        *,
        matches_moments: bool = False,
    ):
        self._env, self._horizon, self._num_paths, self._action_noise = env, horizon, num_paths, action_noise
        self._share_that_goes_on, self._matches_moments = goes_on, matches_moments
        self.num_steps = horizon * num_paths * env.num_envs
        """Imagined steps of all paths together."""
        self._states: Float[Tensor, "n K S_all"] | None = None
        self._ended: Tensor | None = None

    def mean_reward(self, actor: torch.nn.Module) -> Float[Tensor, ""]:
        """The mean reward per step of the actor's paths, differentiable by its parameters."""
        env = self._env
        with torch.no_grad():
            sampler = env.dynamics.draw(env.num_envs, self._horizon, env.generator)
        states, dtype = self._starts(), next(actor.parameters()).dtype
        alive = torch.ones_like(states[..., 0], dtype=torch.bool)
        total = torch.zeros_like(states[..., 0])
        for step in range(self._horizon):
            action = actor(states[..., : env.observation_size].flatten(0, 1).to(dtype))
            noise = torch.randn(action.shape, generator=env.generator, dtype=action.dtype, device=action.device)
            action = env.unscaled((action + self._action_noise * noise).clamp(-1.0, 1.0))
            action = action.to(states).unflatten(0, states.shape[:2])
            after = sampler(states, action, step)
            lost = env.left(after) & alive
            # What is lost has no gradient; in its place a state that keeps what comes after it finite.
            after = torch.where((lost | ~alive).unsqueeze(-1), states.detach(), after)
            earns = alive & ~lost
            if self._matches_moments and earns.any():
                after = after.masked_scatter(
                    earns.unsqueeze(-1), match_moments(after[earns].unsqueeze(1), env.generator)
                )
            reward = env.reward_fn(states, action, after).to(states)
            total = total + torch.where(earns, reward, torch.zeros_like(reward))
            total = total + lost * env.least_reward * (self._horizon - step)
            alive = earns if env.terminated_fn is None else earns & ~env.terminated_fn(after)
            states = after
        self._states, self._ended = states.detach(), ~alive
        return total.mean() / self._horizon

    def _starts(self) -> Float[Tensor, "n K S_all"]:
        env = self._env
        shape = (env.num_envs, self._num_paths)
        fresh = env.starts(shape[0] * shape[1]).unflatten(0, shape)
        if self._states is None or self._ended is None:
            return fresh
        chance = torch.rand(shape, generator=env.generator, dtype=torch.float32, device=fresh.device)
        goes_on = (chance < self._share_that_goes_on) & ~self._ended
        return torch.where(goes_on.unsqueeze(-1), self._states, fresh)
