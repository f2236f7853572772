"""What an agent keeps of the episode that is running in each of its environments."""

from collections.abc import Sequence
from dataclasses import dataclass

from gym_dgpmpc.agents.episode import EpisodeRecord
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.planning.plan_state import PlanState


@dataclass
class RunningEpisode:
    """The episode that is running in one environment.

    Attributes:
        carried: its plan.
        record: what happened in it so far.
        index: its number in the store; -1 before the first one.
        has_explored: whether an episode of random actions has ended in this environment.
    """

    carried: PlanState
    record: EpisodeRecord
    index: int = -1
    has_explored: bool = False


def next_episode(store: TransitionStore, running: Sequence[RunningEpisode]) -> int:
    """A number that neither a stored episode has nor one of those that are running."""
    stored = int(store.episodes.max()) + 1 if len(store) else 0
    return max([stored, *(episode.index + 1 for episode in running)])
