"""The noise in the draws of learned models: what of it moves the state, and what only blurs the observation.

Every model that is fitted shares this. With process noise w and observation noise e, both independent over time,

    x' = f(x, a) + w,  w ~ N(0, Q),      o = x + e,  e ~ N(0, R),      Q and R diagonal,

a model that is fitted to observations calls noise what is left of them, its residuals r_t = w_t + e_{t+1} - A e_t with
A = df/dx. Their variance is Q + R + A R A^T. Consecutive ones share an e, so their covariance is -A R: this is what
tells the two kinds apart. Over a plan the first kind adds up, and the second does not.

In a draw a rollout's states are what would be observed: the model is fed x = o - e, and a new e is added to what it
gives. Being fitted to o it is flatter than f by a factor k = 1 - R / V (regression dilution; V is the variance of o),
so m + (x - m) / k is fed instead of x, with m the mean of o. What was observed at the plan's start is fed as it is, but
for its own error: given o, x is Gaussian about m + k (o - m) with variance k R.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.dynamics.state import take_tensors
from gym_dgpmpc.types import StateDict, Transitions, TransitionSampler

LARGEST_SAMPLE = 1000
"""Transitions, the latest ones, that the covariance of residuals is estimated from."""

FEWEST_PAIRS = 50
"""Pairs of transitions below which all is process noise: a flexible model fits a few points so closely that its
residuals are correlated by the fit alone."""

LARGEST_DILUTION = 0.1
"""Of a slope, by observation noise, up to which it is undone; it is known to first order only."""

SLOPES = 50
"""Transitions that A is averaged over."""

STEP = 0.01
"""Of the finite differences, in standard deviations of an observation: well above the rounding of float32."""


class NoiseSplit(NamedTuple):
    """What part of each target's noise is which, float64."""

    process_share: Float[Tensor, "T"]  # Q over the fitted noise's variance
    observation_variance: Float[Tensor, "T"]  # R, in raw units
    dilution: Float[Tensor, "T"]  # R / V
    centre: Float[Tensor, "T"]  # m, in raw units

    @classmethod
    def all_process(cls, size: int, device: torch.device, share: float = 1.0) -> "NoiseSplit":
        """No observation noise; ``share`` 0 for no noise at all."""
        process, *rest = (torch.full((size,), x, dtype=torch.float64, device=device) for x in (share, 0.0, 0.0, 0.0))
        return cls(process, *rest)

    def observation(self, encoder: Encoder) -> "ObservationNoise | None":
        """Of whole states; None if there is none."""
        if not bool(self.observation_variance.any()):
            return None
        std, stretch, centre = self.observation_variance.new_zeros(3, encoder.observation_size)
        std[encoder.predicted] = self.observation_variance.sqrt()
        stretch[encoder.predicted] = self.dilution / (1.0 - self.dilution)
        centre[encoder.predicted] = self.centre
        return ObservationNoise(std, stretch, centre)

    def metrics(self, variance: Float[Tensor, "T"], unit: Float[Tensor, "T"]) -> dict[str, float]:
        """Both standard deviations, means over the targets, as `fit` reports them.

        Args:
            variance: of the fitted noise, raw units.
            unit: what to report them in, one number for each target.
        """
        return {
            "process_noise_std": float(((self.process_share * variance).sqrt() / unit).mean()),
            "observation_noise_std": float((self.observation_variance.sqrt() / unit).mean()),
        }

    def state(self) -> StateDict:
        """The entries "noise.process_share" to "noise.centre"."""
        return {f"noise.{name}": value for name, value in self._asdict().items()}


def take_noise_split(state: StateDict, size: int, device: torch.device) -> NoiseSplit | None:
    """What `NoiseSplit.state` gave; None if there is nothing of it, as in older files.

    Raises:
        ValueError: only some of the entries are there, or one has another shape.
    """
    if not any(f"noise.{name}" in state for name in NoiseSplit._fields):
        return None
    return NoiseSplit(**take_tensors(state, dict.fromkeys(NoiseSplit._fields, (size,)), device, prefix="noise."))


@torch.no_grad()
def split_noise(
    data: Transitions,
    encoder: Encoder,
    predict: Callable[[Float[Tensor, "n D"]], Float[Tensor, "n T"]],
    variance: Float[Tensor, "T"],
) -> NoiseSplit:
    """Estimate Q and R from the residuals of transitions that follow one another.

    With N the fitted noise's variance, and c the correlation of consecutive residuals of one target,

        R = -c N / (A_ii (1 - N / V)),

    where V is the variance of that number in the data, given the others. The last factor is there because f is fitted
    to o and not to x: its slope is too small by R / V, to first order, and the x that it leaves correlates residuals.
    R is shrunk by the positive part of 1 - (standard error / c)^2, the standard error being n^-1/2 for n pairs.

    All is process noise where c is not negative (of the sign of -A_ii) beyond its standard error; where no transitions
    follow one another, or too few; for the vectors of ``body_frame``, whose axes turn between two residuals; and where
    R / V exceeds `LARGEST_DILUTION`. Angles are not stretched: they have no centre.

    Args:
        data: in any order, on any device.
        encoder: what is fed and predicted.
        predict: the posterior mean of the targets, raw units, from raw inputs; float64 in and out.
        variance: of the fitted noise, raw units.
    """
    size, device = encoder.target_size, variance.device
    recent = Transitions(*(field[-LARGEST_SAMPLE:].to(device, torch.float64) for field in data))
    first, second = consecutive(recent, encoder)
    if len(first) < FEWEST_PAIRS:
        return NoiseSplit.all_process(size, device)

    def residuals(observation: Tensor, action: Tensor, after: Tensor) -> Float[Tensor, "n T"]:
        return encoder.targets(observation, after) - predict(encoder.inputs(observation, action))

    found = residuals(*recent)
    power = found.square().mean(0)
    correlation = (found[first] * found[second]).mean(0) / power.clamp_min(torch.finfo(power.dtype).tiny)
    slopes = _slopes(recent, encoder, residuals)
    squares, own = slopes.square().mean(0), slopes.mean(0).diagonal()
    spread = _spread(recent, encoder)
    gain = own * (1.0 - variance / spread)
    share = torch.where(correlation * gain < 0, -correlation / gain, 0.0)
    share *= (1.0 - 1.0 / (len(first) * correlation.square())).clamp_min(0.0)
    share = torch.minimum(share, 1.0 / (1.0 + squares.diagonal()))
    share[share * variance > LARGEST_DILUTION * spread] = 0.0
    vectors = {*encoder.vectors.x, *encoder.vectors.y}
    share[[column for column, index in enumerate(encoder.predicted) if index in vectors]] = 0.0
    observation = share * variance
    dilution = observation / spread
    dilution[[column for column, index in enumerate(encoder.predicted) if index in encoder.spec.angles]] = 0.0
    process = (variance - observation - squares @ (observation / (1.0 - dilution))).clamp_min(0.0)
    return NoiseSplit(process / variance, observation, dilution, recent.observation.mean(0)[encoder.predicted])


def consecutive(data: Transitions, encoder: Encoder) -> tuple[list[int], list[int]]:
    """The rows that another one goes on from, and those: the first below it that begins where it ended.

    Episodes of several environments may be mixed. What the model neither reads nor carries on is not compared.
    """
    unread = set(encoder.spec.absolute) & set(encoder.spec.not_inputs)
    columns = [i for i in range(encoder.observation_size) if i not in unread]
    starts, ends = (part[:, columns].cpu().contiguous().numpy() for part in (data.observation, data.next_observation))
    pairs, begins_at = list[tuple[int, int]](), dict[bytes, int]()
    for row in reversed(range(len(starts))):
        following = begins_at.get(ends[row].tobytes())
        if following is not None:
            pairs.append((row, following))
        begins_at[starts[row].tobytes()] = row
    pairs.reverse()
    return [row for row, _ in pairs], [following for _, following in pairs]


def _spread(data: Transitions, encoder: Encoder) -> Float[Tensor, "T"]:
    """Variance of every predicted number given the others and the action (linearly); infinite where it is not fed."""
    fed = [i for i in encoder.predicted if i in (*encoder.plain, *encoder.angles)]
    if not fed:
        return data.observation.new_full((encoder.target_size,), torch.inf)
    columns = torch.cat([data.observation[:, fed], data.action], 1)
    variance, mean = torch.var_mean(columns, 0, correction=0)
    scaled = (columns - mean) / torch.where(variance > 0, variance, 1.0).sqrt()
    ridge = 1e-9 * torch.eye(columns.shape[1], dtype=columns.dtype, device=columns.device)
    precision = torch.linalg.inv(scaled.mT @ scaled / len(scaled) + ridge).diagonal()
    spread = variance.new_full((encoder.observation_size,), torch.inf)
    spread[fed] = (variance / precision)[: len(fed)]
    return spread[encoder.predicted]


def _slopes(
    data: Transitions, encoder: Encoder, residuals: Callable[[Tensor, Tensor, Tensor], Tensor]
) -> Float[Tensor, "n T T"]:
    """A at some of the rows: minus the derivative of each residual by each predicted number of the observation."""
    count = len(data.action)
    rows = torch.arange(min(SLOPES, count), dtype=torch.int64, device=data.action.device) * count // min(SLOPES, count)
    observation, action, after = (field[rows] for field in data)
    std = data.observation.std(0, correction=0)
    steps = STEP * torch.where(std > 0, std, 1.0)
    columns = []
    for index in encoder.predicted:
        step = torch.zeros_like(steps)
        step[index] = steps[index]
        change = residuals(observation + step, action, after) - residuals(observation - step, action, after)
        columns.append(-change / (2 * steps[index]))
    return torch.stack(columns, -1)


class ObservationNoise(NamedTuple):
    """What observations of a state differ by, and how a model that was fitted to such is fed, raw units, float64."""

    std: Float[Tensor, "S"]  # of e; zero where nothing is predicted
    stretch: Float[Tensor, "S"]  # 1 / k - 1
    centre: Float[Tensor, "S"]

    def fed(self, state: Float[Tensor, "*b S"]) -> Float[Tensor, "*b S"]:
        """The model's input in place of the true state."""
        return state + self.stretch.to(state.dtype) * (state - self.centre.to(state.dtype))

    @property
    def start_std(self) -> Float[Tensor, "S"]:
        """Of what is fed in place of the first observation, about that."""
        return self.std * (1.0 + self.stretch).sqrt()


class PathNoise(NamedTuple):
    """The noise that P worlds have along a plan: the same for all candidates, so that these meet the same luck."""

    process: Float[Tensor, "H P T"]  # added to the standardised targets
    errors: Float[Tensor, "H_plus_1 P S"] | None  # e, raw units; the first is that of what is fed at the start
    observation: ObservationNoise | None

    @classmethod
    def draw(
        cls,
        process_std: Float[Tensor, "P T"],
        observation: ObservationNoise | None,
        horizon: int,
        num_particles: int,
        dtype: torch.dtype,
        generator: torch.Generator,
    ) -> "PathNoise":
        def normals(length: int, std: Tensor) -> Tensor:
            shape = length, num_particles, std.shape[-1]
            # In single precision as the functions' own, so that the precision of a rollout does not change its noise.
            drawn = torch.randn(shape, generator=generator, dtype=torch.float32, device=std.device)
            return std.to(dtype) * drawn.to(dtype)

        process = normals(horizon, process_std)
        if observation is None:
            return cls(process, None, None)
        errors = torch.cat([normals(1, observation.start_std), normals(horizon, observation.std)])
        return cls(process, errors, observation)

    def fed(self, observation: Float[Tensor, "P K S"], step: int) -> Float[Tensor, "P K S"]:
        """What the model is fed where this is observed."""
        if self.errors is None or self.observation is None:
            return observation
        state = observation - self.errors[step].unsqueeze(1).to(observation.dtype)
        return state if step == 0 else self.observation.fed(state)

    def all_fed(self, states: Float[Tensor, "t P K S"], first: int) -> Float[Tensor, "t P K S"]:
        """`fed` for the steps ``first``, ``first + 1``, ..."""
        if self.errors is None or self.observation is None:
            return states
        true = states - self.errors[first : first + len(states)].unsqueeze(2).to(states.dtype)
        later = 1 if first == 0 else 0
        return torch.cat([true[:later], self.observation.fed(true[later:])])

    def observed(self, state: Float[Tensor, "P K S"], step: int) -> Float[Tensor, "P K S"]:
        """What is observed of the state that this step leads to."""
        return state if self.errors is None else state + self.errors[step + 1].unsqueeze(1).to(state.dtype)

    def all_observed(
        self, states: Float[Tensor, "H_plus_1 P K S"], observation: Float[Tensor, "S"]
    ) -> Float[Tensor, "H_plus_1 P K S"]:
        """What is observed of a whole rollout from this observation; the states are overwritten."""
        if self.errors is not None:
            states[1:] += self.errors[1 : len(states)].unsqueeze(2)
            states[0] = observation
        return states


def observed(
    sampler: TransitionSampler, noise: ObservationNoise | None, generator: torch.Generator
) -> TransitionSampler:
    """The sampler itself, or seen with noise if there is any."""
    return sampler if noise is None else ObservedSampler(sampler, noise, generator)


class ObservedSampler:
    """A sampler whose states are observed with noise, fresh at each point.

    It remembers the e of the states that it gave last, so that it knows what they were without it. Step 0 begins anew:
    what is then given was observed too, and the true state is not known.
    """

    def __init__(self, sampler: TransitionSampler, noise: ObservationNoise, generator: torch.Generator):
        self._sampler, self._noise, self._generator = sampler, noise, generator
        self._last: Tensor | None = None

    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        if step == 0 or self._last is None or self._last.shape != observation.shape:
            fed = observation - self._errors(observation, self._noise.start_std)
        else:
            fed = self._noise.fed(observation - self._last)
        after = self._sampler(fed, action, step)
        self._last = self._errors(after, self._noise.std)
        return after + self._last

    def _errors(self, like: Tensor, std: Tensor) -> Tensor:
        normals = torch.randn(like.shape, generator=self._generator, dtype=like.dtype, device=like.device)
        return std.to(like.dtype) * normals
