"""A dynamics model that is a mixture of others: deep and sparse Gaussian processes and an ensemble of networks.

All members learn from all data. A plan's particles are spread over them by weights, which are what would have predicted
best the transitions that the members had not learned from when they came (`stacking.py`). The draws are in `draws.py`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.checks import check_counts, check_reals, saved_count
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.dynamics.ensemble.model import EnsembleDynamics
from gym_dgpmpc.dynamics.learner import Learner
from gym_dgpmpc.dynamics.mixture.draws import MixtureSampler, Share, share_out
from gym_dgpmpc.dynamics.mixture.stacking import stacking_weights
from gym_dgpmpc.dynamics.predictive import Predictive
from gym_dgpmpc.dynamics.sparse_gp.model import SparseGPDynamics
from gym_dgpmpc.dynamics.state import take_tensor
from gym_dgpmpc.settings import of_member, refuse_unknown, settings_of
from gym_dgpmpc.types import (
    ObservationSpec,
    ProgressFn,
    ReportsDiagnostics,
    StateDict,
    Transitions,
    TransitionSampler,
)

Member = DeepGPDynamics | SparseGPDynamics | EnsembleDynamics

MemberName = Literal["deep-gp", "sparse-gp", "ensemble"]
MEMBERS: Mapping[str, Callable[..., Member]] = MappingProxyType(
    {
        "deep-gp": DeepGPDynamics,
        # Weights are of predictions with noise, so worlds have it too.
        "sparse-gp": partial(SparseGPDynamics, add_noise=True),
        # Networks that are trained for a few epochs alone predict worse than they could, and are not heard then.
        "ensemble": partial(EnsembleDynamics, num_epochs=300, patience=15),
    }
)
"""What a mixture may be made of, by name, with the defaults that differ from the model's own."""

PARTICLES_MEET = ("MM", "AMM")
"""Draws that look at all particles of a candidate together: a share of them has other moments, and one alone none."""

PROGRESS_OF_A_MEMBER = 1000
"""Units of progress that the training of one member is, however many iterations it takes."""


class _Fitted(NamedTuple):
    weights: Float[Tensor, "M"]  # float64
    log_density: Float[Tensor, "n M"]  # float64: of the latest transitions that were held out
    num_seen: int  # transitions that members may have learned from


class MixtureDynamics(Learner[_Fitted]):
    """Implements `DynamicsModel` with several models, each of which has a part of the particles.

    Every few transitions one is held out: before any member learns from it, within an episode or at a training, each
    predicts it. At a training the latest of these decide the members' weights. Before there are any, weights are equal.

    Args:
        observation_size: numbers in an observation, S.
        action_size: numbers in an action, A.
        observation_spec: how to read the observation.
        members: names of the models, each once: "deep-gp", "sparse-gp" and "ensemble".
        score_every: of so many transitions in a row one is held out; those next to it are much like it, and say
            little more.
        evidence_share: of all transitions, the share, counted from the latest, of which those held out decide the
            weights: how well the members predicted after less than half of the data says less of how they do now.
        dtype: precision of rollouts.
        device: where tensors live.
        **settings: those of the members, each under the member's name and its own: ``deep_gp_num_layers``.

    Attributes:
        models: the members by name.

    Raises:
        TypeError: a setting is unknown.
        ValueError: a setting is out of its range.
    """

    members_by_name: ClassVar[Mapping[str, Callable[..., Member]]] = MEMBERS
    """Parts whose settings the constructor takes too; see `settings.settings_of`."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        observation_spec: ObservationSpec | None = None,
        *,
        members: Sequence[MemberName] = ("deep-gp", "ensemble"),
        score_every: int = 5,
        evidence_share: float = 0.5,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        **settings: Any,
    ):
        if isinstance(members, str) or not members or not set(members) <= set(MEMBERS):
            raise ValueError(
                f"members must be some of {', '.join(MEMBERS)}, such as ('deep-gp',), received {members!r}"
            )
        if len(set(members)) != len(members):
            raise ValueError(f"members must be named once each, received {members!r}")
        check_counts(score_every=score_every)
        check_reals("(0, 1]", evidence_share=evidence_share)
        own = {name: {of_member(name, each): each for each in settings_of(make)} for name, make in MEMBERS.items()}
        refuse_unknown("MixtureDynamics", settings, [each for names in own.values() for each in names])
        super().__init__(observation_size, action_size, observation_spec, dtype, device)
        self.score_every, self.evidence_share = score_every, evidence_share
        shape = observation_size, action_size, observation_spec
        self._make: dict[str, Callable[[], Member]] = {
            name: partial(
                MEMBERS[name],
                *shape,
                **{short: settings[long] for long, short in own[name].items() if long in settings},
                dtype=dtype,
                device=device,
            )
            for name in members
        }
        self.models: dict[str, Member] = {name: make() for name, make in self._make.items()}
        for name, member in self.models.items():
            if member.draw_kind in PARTICLES_MEET:
                raise ValueError(
                    f"the draw {member.draw_kind} moves all particles together, of which a member of a mixture has "
                    f"only some: choose another {of_member(name, 'draw')}"
                )

    def fit(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Let the members predict what is held out of the new transitions, train them on all, and weigh them.

        While one member is trained `on_progress` hears of its losses, which are of another kind than the next one's.

        Returns:
            The metrics of every member under its name ("deep_gp_rollbacks") with its weight ("deep_gp_weight"), the
            sum of their ``iterations``, and ``num_held_out``, the transitions that decided the weights.

        Raises:
            ValueError: there are no transitions.
            TrainingError: a member's training failed, which is as it was; those before it in order are trained.
        """
        if self._fitted is not None:
            self._hold_out(data, generator)
        metrics: dict[str, float] = {"iterations": 0.0}
        for index, (name, member) in enumerate(self.models.items()):
            member.on_progress = self._progress_of(index)
            try:
                found = member.fit(data, generator)
            finally:
                member.on_progress = None
            metrics |= {of_member(name, each): value for each, value in found.items()}
            metrics["iterations"] += found["iterations"]
        log_density = self._recent(len(data.action))
        weights = stacking_weights(log_density)
        self._fitted = _Fitted(weights, log_density, len(data.action))
        return metrics | self._weights_by_name(weights) | {"num_held_out": float(len(log_density))}

    def resample(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Let the members predict what is held out of the new transitions, then follow the data as each does.

        Weights stay as they are until the next training.

        Raises:
            RuntimeError: the model was not fitted.
        """
        self._require_fit("resample")
        self._hold_out(data, generator)
        return {
            of_member(name, each): value
            for name, member in self.models.items()
            for each, value in member.resample(data, generator).items()
        }

    def draw(self, num_particles: int, horizon: int, generator: torch.Generator) -> TransitionSampler:
        """Worlds for plans of ``horizon`` steps, shared out over the members by their weights.

        Every member draws from a generator of its own, so that its worlds are those that it would draw alone.

        Raises:
            RuntimeError: the model was not fitted.
        """
        weights = self._require_fit("draw").weights
        counts = share_out(num_particles, weights, generator)
        seeds = torch.randint(2**62, (len(counts),), generator=generator, device=self.device).tolist()
        return MixtureSampler(
            [
                Share(member.draw(count, horizon, torch.Generator(self.device).manual_seed(seed)), count)
                for member, count, seed in zip(self.models.values(), counts, seeds, strict=True)
                if count > 0
            ]
        )

    @torch.no_grad()
    def predictive(self, data: Transitions, generator: torch.Generator) -> Predictive:
        """The mixture of what the members expect; see `Learner.predictive`."""
        log_weights = self._require_fit("predict").weights.log()
        found = [member.predictive(data, generator) for member in self.models.values()]
        mean, variance, log_density = (torch.stack(parts) for parts in zip(*found, strict=True))
        weights = log_weights.exp()[:, None, None]
        overall = (weights * mean).sum(0)
        spread = (weights * (variance + (mean - overall).square())).sum(0)
        return Predictive(overall, spread, (log_weights[:, None] + log_density).logsumexp(0))

    def diagnostics(self) -> dict[str, float]:
        """The weight of each member, and what it says itself, under its name."""
        if self._fitted is None:
            return {}
        metrics = self._weights_by_name(self._fitted.weights)
        for name, member in self.models.items():
            if isinstance(member, ReportsDiagnostics):
                metrics |= {of_member(name, each): value for each, value in member.diagnostics().items()}
        return metrics

    def _weights_by_name(self, weights: Float[Tensor, "M"]) -> dict[str, float]:
        return {of_member(name, "weight"): float(w) for name, w in zip(self.models, weights, strict=True)}

    def state_dict(self) -> StateDict:
        """Those of the members, each under its name, with the weights and what they rest on; empty before a fit."""
        if self._fitted is None:
            return {}
        state: StateDict = self._fitted._asdict()
        for name, member in self.models.items():
            state |= {f"{name}.{key}": value for key, value in member.state_dict().items()}
        return state

    def load_state_dict(self, state: StateDict) -> None:
        """Restore `state_dict` of a model with the same settings.

        Raises:
            ValueError: an entry is missing or is not what these settings give it; the model stays as it was.
        """
        members = {name: make() for name, make in self._make.items()}
        if not state:
            self.models, self._fitted = members, None
            return
        received = state.get("log_density")
        num_held_out = len(received) if isinstance(received, Tensor) and received.ndim == 2 else 0
        weights = take_tensor(state, "weights", (len(members),), self.device)
        if not (bool((weights >= 0).all()) and math.isclose(float(weights.sum()), 1.0, rel_tol=1e-9)):
            raise ValueError(f"dynamics state 'weights': expected shares of 1, received {weights.tolist()}")
        fitted = _Fitted(
            weights,
            take_tensor(state, "log_density", (num_held_out, len(members)), self.device),
            saved_count("dynamics state 'num_seen'", state.get("num_seen")),
        )
        for name, member in members.items():
            own = {key.removeprefix(f"{name}."): value for key, value in state.items() if key.startswith(f"{name}.")}
            if not own:
                raise ValueError(f"dynamics state '{name}.*': expected the entries of this member, received None")
            try:
                member.load_state_dict(own)
            except ValueError as error:
                raise ValueError(f"the member {name!r}: {error}") from error
        self.models, self._fitted = members, fitted

    @torch.no_grad()
    def _hold_out(self, data: Transitions, generator: torch.Generator) -> None:
        """Keep how well every member predicts those new transitions that are held out."""
        fitted, count = self._require_fit("predict"), len(data.action)
        first = -(-fitted.num_seen // self.score_every) * self.score_every
        held_out = Transitions(*(field[first :: self.score_every] for field in data))
        log_density = fitted.log_density
        if len(held_out.action) > 0:
            found = [member.predictive(held_out, generator).log_density for member in self.models.values()]
            log_density = torch.cat([log_density, torch.stack(found, -1).double()])
        self._fitted = fitted._replace(log_density=log_density, num_seen=count)

    def _recent(self, count: int) -> Float[Tensor, "n M"]:
        """Of the transitions that were held out those among the latest ``evidence_share`` of so many."""
        if self._fitted is None:
            return torch.empty(0, len(self.models), dtype=torch.float64, device=self.device)
        oldest = math.ceil((1.0 - self.evidence_share) * count)
        num_recent = len(range(-(-oldest // self.score_every) * self.score_every, count, self.score_every))
        log_density = self._fitted.log_density
        return log_density[max(len(log_density) - num_recent, 0) :]

    def _progress_of(self, index: int) -> ProgressFn | None:
        """How a member tells of its training as a part of the whole."""
        report = self.on_progress
        if report is None:
            return None
        unit, total = PROGRESS_OF_A_MEMBER, PROGRESS_OF_A_MEMBER * len(self.models)

        def report_part(done: int, of: int, loss: float) -> None:
            report(index * unit + unit * done // of, total, loss)

        return report_part
