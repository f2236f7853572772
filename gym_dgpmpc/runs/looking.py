"""Looking inside an agent while it learns, from a script: a Stable-Baselines3 callback that logs what it sees.

`looking_back.py` computes, `looking_figures.py` draws, and `looking_video.py` keeps an episode's pictures.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure as Picture
from numpy import ndarray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure, KVWriter, TensorBoardOutputFormat

from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.agents.forecasting import draw_worlds
from gym_dgpmpc.checks import check_counts, check_reals
from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.runs.figures import observation_labels, prediction_fan
from gym_dgpmpc.runs.looking_back import (
    SCORES,
    Compared,
    PlayedEpisode,
    compare,
    picked_starts,
    plan_scores,
    played,
    predicted_numbers,
)
from gym_dgpmpc.runs.looking_figures import planning_figure, score_figure, training_figure
from gym_dgpmpc.runs.looking_video import EpisodeVideo
from gym_dgpmpc.runs.recording import NUM_FORECAST_PARTICLES
from gym_dgpmpc.types import (
    ProgressFn,
    ReportsDiagnostics,
    ReportsProgress,
    ReportsScales,
    TransitionSampler,
)

DIAGNOSTICS = ("effective_sample_size", "r_hat", "noise_std")
"""Of those that a model reports, which are shown."""

SATURATED = 0.01
"""An action within this share of its range of a bound counts as saturated."""

FIRST_GUESS = 0.7
"""Seconds that a picture is expected to take before it was drawn once."""

PREDICTED, OBTAINED = "look/predicted_reward_per_step", "look/obtained_reward_per_step"
LAYOUT = {
    "LookInside": {
        "reward per step": ["Multiline", [PREDICTED, OBTAINED]],
        "coverage": ["Multiline", ["look/coverage_50", "look/coverage_90"]],
    }
}
"""TensorBoard's custom scalars: charts of more than one number."""


class _Watched(NamedTuple):
    """The episode of the first environment while it runs."""

    episode: int
    """Its number in the store."""
    starts: list[int]
    """Steps at which forecasts are still to begin."""
    worlds: dict[int, TransitionSampler]
    """By the step at which they were drawn."""
    plan_scores: list[Float[ndarray, " K"]]


class _Losses:
    """Listens to a model's training, and keeps the losses of the last one."""

    def __init__(self, kept: list[tuple[int, float]], listener: ProgressFn | None):
        self.kept, self.listener = kept, listener

    def __call__(self, done: int, total: int, loss: float) -> None:
        if self.kept and done <= self.kept[-1][0]:
            self.kept.clear()
        self.kept.append((done, loss))
        if self.listener is not None:
            self.listener(done, total, loss)


class LookInside(BaseCallback):
    """Logs what the model foresaw, how its training went and what the planner did, once an episode.

        agent.learn(3_000, callback=LookInside())

    To every output of the logger go numbers, named ``look/...``; to TensorBoard pictures, histograms, settings and
    charts of its custom scalars besides. They are written at once, apart from what the agent logs. Forecasts begin at
    steps that were picked before their episode, and are made then, before the model has seen what follows. Of several
    environments the first is looked at; rewards are of all. Called more rarely than at each step, as by SB3's
    `EveryNTimesteps`, forecasts begin where it is called, and an episode is looked at when it is called next.

    The agent acts as it would without: nothing that it draws from is moved, nor is what waits in its logger.

    Args:
        num_windows: forecasts of an episode.
        num_particles: worlds of each.
        share: the most processor time to spend on looking, of that of the whole run, in (0, 1]: pictures beyond it are
            left out until it suffices again, the longest missing comes first then; 1 draws them all. Numbers always
            come, and so does each picture once, when learning ends at the latest.
        video: log each episode as a moving picture with step, return and action in it, too; the environment must render
            ``rgb_array``. It does not count towards ``share``.

    Attributes:
        seconds: processor time spent so far, but for the video.
        pictures: the newest pictures by name, as Matplotlib figures; none without a TensorBoard output.

    Raises:
        TypeError, ValueError: an argument is out of its range; or, when learning begins, the algorithm is no `MPCAgent`
            or the environment does not render.
    """

    def __init__(
        self,
        num_windows: int = 2,
        num_particles: int = NUM_FORECAST_PARTICLES,
        *,
        share: float = 0.02,
        video: bool = False,
    ):
        super().__init__()
        check_counts(num_windows=num_windows, num_particles=num_particles)
        check_reals("(0, 1]", share=share)
        self.num_windows, self.num_particles, self.share, self.video = num_windows, num_particles, share, video
        self.seconds, self.pictures = 0.0, dict[str, Picture]()
        self._started = time.process_time()
        self._costs, self._newest = dict[str, float](), dict[str, int]()  # of pictures by name: seconds, timestep
        self._drawable: dict[str, Callable[[], Picture]] = {}
        self._left_out: dict[str, Callable[[], Picture]] = {}  # the newest of those that were never drawn
        self._heard: ReportsProgress | None = None  # whose training is listened to
        self._ear: _Losses | None = None  # by what
        self._watched: _Watched | None = None
        self._losses: list[tuple[int, float]] = []
        self._rewards: dict[int, tuple[float, float]] = {}
        self._film: EpisodeVideo | None = None

    @property
    def agent(self) -> MPCAgent:
        """The agent that learns."""
        if not isinstance(self.model, MPCAgent):
            raise TypeError(f"LookInside looks into an MPCAgent, got {type(self.model).__name__}")
        return self.model

    # ------------------------------------------------------------------------------------------ while an episode runs

    def _on_training_start(self) -> None:
        with self._counted():
            self._listen()
            rows = "\n".join(f"| {name} | {value} |" for name, value in self.agent.arguments().items())
            self._write_pictures({"settings": f"| setting | value |\n|---|---|\n{rows}"})
            for output in self._tensorboard:
                output.writer.add_custom_scalars(LAYOUT)
        if self.video:
            self._film = EpisodeVideo(self.training_env)

    def _on_rollout_start(self) -> None:
        self._listen()

    def _on_step(self) -> bool:
        agent = self.agent
        assert agent._last_episode_starts is not None
        has_ended, running = agent._last_episode_starts, agent.collector.running[0]
        if self._film is not None:
            self._add_to_film(self._film, has_ended=bool(has_ended[0]))
        with self._counted():
            self._listen()
            self._add_rewards(np.flatnonzero(has_ended))
            if self._watched is None or self._watched.episode != running.index:
                self._look_back()
                starts = picked_starts(agent, running.index, self.num_windows)
                self._watched = _Watched(running.index, starts, {}, [])
            if has_ended[0]:
                self._look_back()
            elif agent.is_fitted:
                self._look_ahead(self._watched, len(running.record.rewards))
        self._draw()
        return True

    def _on_training_end(self) -> None:
        self._stop_listening()
        for name in tuple(self._left_out):
            self._draw_one(name, self._left_out[name])

    def _listen(self) -> None:
        """Hear of the model's losses; asked again and again, since an agent may begin with a model anew."""
        model = self.agent.dynamics
        if not isinstance(model, ReportsProgress) or model is self._heard:
            return
        self._stop_listening()
        self._heard, self._ear = model, _Losses(self._losses, model.on_progress)
        model.on_progress = self._ear

    def _stop_listening(self) -> None:
        """Leave the model as it was."""
        if self._heard is not None and self._ear is not None:
            self._heard.on_progress = self._ear.listener
        self._heard = self._ear = None

    def _look_ahead(self, watched: _Watched, step: int) -> None:
        """Draw the worlds of a forecast, if one is to begin by now."""
        due = [start for start in watched.starts if start <= step]
        if not due:
            return
        del watched.starts[: len(due)]
        key = self.agent.num_timesteps
        if not watched.worlds and self.agent.episode_records[0].plans:
            watched.plan_scores.extend(plan_scores(self.agent, key))
        watched.worlds[step] = draw_worlds(self.agent, self.num_particles, self.agent.controller.horizon, key)

    def _add_rewards(self, ended: ndarray) -> None:
        """What the plans of the episodes that have just ended expected of a step, and what it brought."""
        records = [self.agent.episode_records[index] for index in ended]
        latest = {record.number: record.predicted_and_obtained() for record in records if record.plans}
        if latest:
            self._rewards |= latest
            predicted, obtained = np.mean(list(latest.values()), axis=0)
            self._write({PREDICTED: float(predicted), OBTAINED: float(obtained)})

    def _add_to_film(self, film: EpisodeVideo, *, has_ended: bool) -> None:
        if has_ended:  # the environment has been reset, so that its picture is of the next episode
            film.write(self._tensorboard, self.num_timesteps)
        else:
            last = self.agent.store.transitions().action[-self.agent.n_envs]
            film.add(self.agent.episode_records[0].rewards, last.numpy())

    # ---------------------------------------------------------------------------------------- when it has ended

    def _look_back(self) -> None:
        """Log the episode that was watched, once."""
        watched, self._watched = self._watched, None
        episode = None if watched is None else played(self.agent, watched.episode)
        if watched is None or episode is None:
            return
        compared = compare(self.agent, watched.worlds, episode, self.num_particles)
        self._write({f"look/{name}": value for name, value in self._numbers(watched, episode, compared).items()})
        self._write_pictures({f"action_{index}": column.copy() for index, column in enumerate(episode.actions.T)})
        self._drawable = self._pictures_of(watched, episode, compared)

    def _draw(self) -> None:
        """Draw and log what was looked at, as far as there is time, what was left out longest first."""
        drawable, self._drawable = self._drawable, {}
        for name in sorted(drawable, key=lambda name: self._newest.get(name, -1)) if self._tensorboard else ():
            left = self.share * (time.process_time() - self._started) - self.seconds
            if self.share == 1 or self._costs.get(name, FIRST_GUESS) <= left:
                self._draw_one(name, drawable[name])
            elif name not in self._newest:
                self._left_out[name] = drawable[name]

    def _draw_one(self, name: str, draw: Callable[[], Picture]) -> None:
        before = self.seconds
        with self._counted():
            self.pictures[name] = draw()
            self._write_pictures({name: Figure(self.pictures[name], close=False)})
        self._costs[name], self._newest[name] = self.seconds - before, self.num_timesteps
        self._left_out.pop(name, None)

    def _numbers(self, watched: _Watched, episode: PlayedEpisode, compared: Compared | None) -> dict[str, float]:
        """What can be said of an episode in numbers."""
        low, high = self._bounds
        margin, model = SATURATED * (high - low), self.agent.dynamics
        saturated = (episode.actions <= low + margin) | (episode.actions >= high - margin)
        numbers = {"saturated_actions": float(saturated.mean())}
        if isinstance(model, ReportsDiagnostics):
            numbers |= {name: value for name, value in model.diagnostics().items() if name in DIAGNOSTICS}
        if watched.plan_scores:
            for name, found in (("first", watched.plan_scores[0]), ("last", watched.plan_scores[-1])):
                finite = found[np.isfinite(found)]
                numbers[f"plan_score_std_{name}"] = float(finite.std()) if len(finite) else float("nan")
        if compared is not None:
            last = len(compared.spread)
            numbers |= {name: float(np.nanmean(compared.scores[name])) for name in SCORES}
            for step in sorted({1, (last + 1) // 2, last}):
                numbers |= {f"{name}_step_{step}": float(compared.scores[name][step - 1]) for name in SCORES}
                numbers[f"particle_std_step_{step}"] = float(compared.spread[step - 1].mean())
        return numbers

    def _pictures_of(
        self, watched: _Watched, episode: PlayedEpisode, compared: Compared | None
    ) -> dict[str, Callable[[], Picture]]:
        """How to draw each picture of an episode."""
        agent, env = self.agent, self.agent.get_env()
        modelled, model, losses = agent.task.modelled, agent.dynamics, list(self._losses)
        assert env is not None
        labels = observation_labels(type(env.get_attr("unwrapped", [0])[0]), modelled.observation_size)
        scales = model.scales() if isinstance(model, ReportsScales) else None
        rewards = [(number, *pair) for number, pair in sorted(self._rewards.items())]

        def training() -> Picture:
            of_all = [*labels, *["reward"] * modelled.reward, *["termination"] * modelled.terminated]
            encoder = Encoder(modelled.size, episode.actions.shape[1], modelled.spec)
            inputs = encoder.input_names(of_all, [f"action {i}" for i in range(encoder.action_size)])
            return training_figure(losses, scales, inputs, [of_all[i] for i in encoder.predicted])

        drawable: dict[str, Callable[[], Picture]] = {}
        if compared is not None:
            title = f"forecasts of the episode that ended at step {self.num_timesteps}"
            names = [labels[i] for i in predicted_numbers(agent)]
            drawable["fan"] = partial(prediction_fan, compared.forecasts, labels=[*labels, "reward"], title=title)
            drawable["scores"] = partial(score_figure, compared.scores, compared.spread, names)
        drawable["planning"] = partial(planning_figure, watched.plan_scores, episode.actions, self._bounds, rewards)
        if scales is not None or losses:
            drawable["training"] = training
        return drawable

    @property
    def _bounds(self) -> tuple[Float[ndarray, " A"], Float[ndarray, " A"]]:
        space = self.agent.action_space
        return space.low.reshape(-1), space.high.reshape(-1)

    # ------------------------------------------------------------------------------------------------------ writing

    @property
    def _tensorboard(self) -> list[TensorBoardOutputFormat]:
        return [each for each in self.logger.output_formats if isinstance(each, TensorBoardOutputFormat)]

    def _write(self, numbers: Mapping[str, float]) -> None:
        """Give every output of the logger numbers, at once: what waits in the logger stays there."""
        for output in self.logger.output_formats:
            if isinstance(output, KVWriter):
                output.write(dict(numbers), dict.fromkeys(numbers, ()), self.num_timesteps)

    def _write_pictures(self, values: Mapping[str, Any]) -> None:
        """Give TensorBoard what other outputs cannot show."""
        named = {f"look/{name}": value for name, value in values.items()}
        for output in self._tensorboard:
            output.write(named, dict.fromkeys(named, ()), self.num_timesteps)

    @contextmanager
    def _counted(self) -> Iterator[None]:
        """Count the processor time of what is done within."""
        began = time.process_time()
        try:
            yield
        finally:
            self.seconds += time.process_time() - began
