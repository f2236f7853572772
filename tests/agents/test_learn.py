"""Learning: what is stored, when the model is trained, what repeats, and what survives a failure."""

import warnings

import numpy as np
import pytest
import torch
from gymnasium.wrappers import TimeLimit

from gym_dgpmpc import MPCAgent
from gym_dgpmpc.errors import EnvironmentDataError, EnvironmentFailedError, PlanningError
from gym_dgpmpc.planning.cem import CEM
from tests.agents.point_mass import LENGTH, KnownPointMass, LinearModel, actions_of, agent, planner


def test_it_learns_the_point_mass_from_one_random_episode():
    """Standing still at a start in [0.5, 1] costs 2.5 to 10; with the exact model most of that is saved."""
    learner = agent(KnownPointMass(fixed_start=True))
    learner.learn(4 * LENGTH)
    returns = learner.store.rewards.reshape(4, LENGTH).sum(1)
    assert (returns[1:] > -4.0).all()
    optimal_start = -((1.0 + 0.3 * 0.3 * -2.0) ** 2)
    assert learner.store.rewards[LENGTH] >= optimal_start - 0.2


@pytest.mark.parametrize("total", [7, LENGTH, 25])
def test_total_timesteps_counts_every_step(total):
    learner = agent()
    learner.learn(total)
    assert learner.num_timesteps == len(learner.store) == len(learner.env.get_attr("steps")[0]) == total


def test_a_negative_number_of_steps_is_refused():
    learner = agent()
    with pytest.raises(ValueError, match=r"total_timesteps.*-5"):
        learner.learn(-5)
    assert len(learner.store) == 0


def test_the_store_holds_what_the_environment_did():
    """Also at an episode's end, where a VecEnv returns the next episode's first observation."""
    learner = agent()
    learner.learn(35)
    observation, action, after = (np.array(column) for column in zip(*learner.env.get_attr("steps")[0], strict=True))
    stored = learner.store.transitions()
    np.testing.assert_allclose(stored.observation, observation, atol=1e-6)
    np.testing.assert_allclose(stored.action, action, atol=1e-6)
    np.testing.assert_allclose(stored.next_observation, after, atol=1e-6)
    assert learner.store.episodes.tolist() == [i // LENGTH for i in range(35)]
    assert not learner.store.terminated.any()


def test_termination_is_told_from_truncation():
    env, terminated_fn = KnownPointMass(terminate_beyond=1.2), lambda after: after[..., 0].abs() > 1.2
    learner = agent(env, terminated_fn=terminated_fn, learning_starts=60)
    learner.learn(60)
    beyond = learner.store.transitions().next_observation[:, 0].abs() > 1.2
    assert beyond.any()
    assert torch.equal(learner.store.terminated, beyond)


def test_a_termination_nobody_told_the_planner_of_warns_once():
    learner = agent(KnownPointMass(terminate_beyond=1.2), learning_starts=60)
    with pytest.warns(UserWarning, match="terminated_fn") as warned:
        learner.learn(60)
    assert learner.store.terminated.sum() > 1
    assert len([w for w in warned if "terminated_fn" in str(w.message)]) == 1


def test_algorithm_2_trains_at_each_episode_and_resamples_after_each_controlled_step():
    learner = agent()
    learner.learn(35)
    assert learner.dynamics.fits == [10, 20, 30]
    assert learner.dynamics.resamples == 25


def test_training_also_follows_an_episode_that_ends_the_call_and_is_not_repeated():
    learner = agent()
    learner.learn(20)
    assert learner.dynamics.fits == [10, 20]
    learner.learn(20, reset_num_timesteps=False)
    assert learner.dynamics.fits == [10, 20, 30, 40]


def test_the_first_episode_is_uniformly_random():
    learner = agent(learning_starts=1000)
    learner.learn(1000)
    actions = actions_of(learner.env.envs[0])
    assert learner.dynamics.fits == [1000]
    assert np.all(np.abs(actions) <= 2.0)
    # The variance of a uniform variable of width 4 is 16 / 12; standard errors are 0.037 and 0.038.
    assert abs(actions.mean()) < 0.16
    assert abs(actions.var() - 16 / 12) < 0.16


@pytest.mark.parametrize(("learning_starts", "first_fit"), [(None, 10), (4, 4), (13, 13)])
def test_learning_starts_counts_random_steps(learning_starts, first_fit):
    learner = agent(learning_starts=learning_starts)
    learner.learn(25)
    assert learner.dynamics.fits[0] == first_fit
    assert learner.dynamics.resamples == 25 - first_fit


def test_calls_shorter_than_an_episode_train_once_they_are_as_long_together():
    """Each begins a new episode, so that none ever ends."""
    learner = agent(TimeLimit(KnownPointMass(), LENGTH))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(6):
            learner.learn(4)
    assert learner.dynamics.fits == [LENGTH, 12, 16, 20]
    assert len(actions_of(learner.env.envs[0])) == 24


def test_calls_much_shorter_than_an_episode_say_so_before_it_is_long():
    learner = agent(TimeLimit(KnownPointMass(), 500))
    with pytest.warns(UserWarning, match=r"\b500 random steps") as warned:
        for _ in range(15):
            learner.learn(2)
    assert len(warned) == 1


def test_calls_shorter_than_an_episode_without_a_known_limit_say_so_once():
    learner = agent()
    with pytest.warns(UserWarning, match="reset_num_timesteps=False") as warned:
        for _ in range(6):
            learner.learn(4)
    assert len(warned) == 1
    assert learner.dynamics.fits == []
    for _ in range(6):
        learner.learn(4, reset_num_timesteps=False)
    assert learner.dynamics.fits == [30, 40]


def test_learning_again_keeps_the_data_and_does_not_explore_again():
    learner = agent()
    learner.learn(15)
    learner.learn(15)
    assert learner.num_timesteps == 15
    assert len(learner.store) == 30
    assert learner.dynamics.resamples == 20
    assert learner.store.episodes.tolist() == [0] * 10 + [1] * 5 + [2] * 10 + [3] * 5


@pytest.mark.parametrize("first", [3, 10, 17, 20])
def test_two_calls_do_what_one_does(first):
    once, twice = agent(), agent()
    once.learn(34)
    twice.learn(first)
    twice.learn(34 - first, reset_num_timesteps=False)
    assert twice.num_timesteps == 34
    np.testing.assert_array_equal(actions_of(once.env.envs[0]), actions_of(twice.env.envs[0]))


def test_one_seed_decides_everything():
    runs = [agent(seed=seed) for seed in (3, 3, 4)]
    for run in runs:
        run.learn(25)
    np.testing.assert_array_equal(runs[0].store.transitions().next_observation, runs[1].store.transitions()[2])
    assert not np.array_equal(actions_of(runs[0].env.envs[0]), actions_of(runs[2].env.envs[0]))


def test_every_use_of_randomness_has_its_own_generator():
    used = {"fit": set(), "resample": set(), "draw": set()}

    class Recording(LinearModel):
        def __getattribute__(self, name):
            method = super().__getattribute__(name)
            if name in used:
                return lambda *arguments: used[name].add(arguments[-1]) or method(*arguments)
            return method

    learner = agent(dynamics=Recording()).learn(25)
    learner.predict(np.zeros(2))
    generators = learner.generators
    assert used["fit"] == used["resample"] == {generators.fit}
    assert used["draw"] == {generators.planning, generators.prediction}


def test_global_random_state_does_not_matter():
    first = agent()
    first.learn(25)
    second = agent()
    torch.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002
    second.learn(25)
    np.testing.assert_array_equal(actions_of(first.env.envs[0]), actions_of(second.env.envs[0]))


def test_an_agent_without_a_seed_can_be_repeated_from_the_one_it_drew():
    first = agent(KnownPointMass(fixed_start=True), seed=None)
    first.learn(25)
    again = agent(KnownPointMass(fixed_start=True), seed=first.seed)
    again.learn(25)
    assert agent(seed=None).seed != first.seed
    np.testing.assert_array_equal(actions_of(first.env.envs[0]), actions_of(again.env.envs[0]))


@pytest.mark.parametrize("actions_per_plan", [1, 2, 5])
def test_actions_per_plan(actions_per_plan):
    learner = agent(actions_per_plan=actions_per_plan)
    plans = []
    make = learner.planner.plan

    def recorded(objective, plan, generator, deadline):
        found = make(objective, plan, generator, deadline)
        plans.append(found[0].mean.numpy().copy())
        return found

    learner.planner.plan = recorded
    learner.learn(2 * LENGTH)
    assert len(plans) == LENGTH // actions_per_plan
    performed = np.concatenate([plan[:actions_per_plan] for plan in plans])
    np.testing.assert_allclose(actions_of(learner.env.envs[0])[LENGTH:], performed, atol=1e-6)


def test_every_episode_starts_from_a_cold_plan():
    learner = agent()
    starts = []
    make = learner.planner.plan

    def recorded(objective, plan, generator, deadline):
        starts.append(plan.mean.clone())
        return make(objective, plan, generator, deadline)

    learner.planner.plan = recorded
    learner.learn(3 * LENGTH)
    cold = learner.planner.initial_plan().mean
    assert [torch.equal(start, cold) for start in starts] == ([True] + [False] * (LENGTH - 1)) * 2


@pytest.mark.parametrize("failure", [np.nan, np.inf, ("reward", np.nan)])
@pytest.mark.parametrize("fail_at", [4, 9, 23])
def test_data_that_is_not_finite_stops_the_run_and_loses_nothing(failure, fail_at):
    learner = agent(KnownPointMass(fail_at=fail_at, failure=failure))
    with pytest.raises(EnvironmentDataError, match=rf"step {fail_at}\b"):
        learner.learn(30)
    assert len(learner.store) == learner.num_timesteps == fail_at
    learner.learn(30 - fail_at, reset_num_timesteps=False)
    assert len(learner.store) == 30
    assert len(set(learner.store.episodes.tolist())) >= 2
    assert learner.store.episodes.diff()[fail_at - 1] == 1


def test_a_reset_that_is_not_finite():
    env = KnownPointMass()
    learner = agent(env)
    learner.learn(15)
    reset = env.reset
    env.reset = lambda **kwargs: (np.array([np.nan, 0.0]), {})
    with pytest.raises(EnvironmentDataError, match=r"\b20 steps.*reset.*nan"):
        learner.learn(15, reset_num_timesteps=False)
    assert len(learner.store) == 20
    env.reset = reset
    learner.learn(5, reset_num_timesteps=False)
    assert len(learner.store) == 25


def test_an_environment_that_raises():
    learner = agent(KnownPointMass(fail_at=13, failure=ConnectionError("the plant is gone")))
    with pytest.raises(EnvironmentFailedError, match=r"^step 13: .*ConnectionError: the plant") as raised:
        learner.learn(30)
    assert isinstance(raised.value.__cause__, ConnectionError)
    assert len(learner.store) == 13
    learner.learn(17, reset_num_timesteps=False)
    assert len(learner.store) == 30


def test_an_environment_whose_reset_raises_keeps_the_step_that_ended_the_episode():
    env = KnownPointMass()
    learner = agent(env)
    reset = env.reset
    env.reset = lambda **kwargs: reset(**kwargs) if env.num_steps != 2 * LENGTH else 1 / 0
    with pytest.raises(EnvironmentFailedError, match=r"step 19: .*reset .*ZeroDivisionError"):
        learner.learn(30)
    assert len(learner.store) == learner.num_timesteps == 2 * LENGTH
    env.reset = reset
    learner.learn(10, reset_num_timesteps=False)
    assert learner.dynamics.fits == [10, 20, 30]
    assert learner.store.episodes.tolist() == [i // LENGTH for i in range(30)]


def test_what_resampling_tells_is_logged_as_its_mean():
    learner = agent()
    resample, told = learner.dynamics.resample, iter([1.0, 0.0, 0.0, 1.0])
    learner.dynamics.resample = lambda data, generator: {**resample(data, generator), "dropped": next(told)}
    learner.learn(LENGTH + 4, log_interval=10)
    assert learner.logger.name_to_value["train/dropped"] == pytest.approx(0.5)


def test_training_that_fails_can_be_tried_again():
    class Failing(LinearModel):
        def fit(self, data, generator):
            if len(data.observation) == 20 and not hasattr(self, "failed"):
                self.failed = True
                raise FloatingPointError("diverged")
            return super().fit(data, generator)

    learner = agent(dynamics=Failing())
    with pytest.raises(FloatingPointError, match="diverged"):
        learner.learn(30)
    assert len(learner.store) == learner.num_timesteps == 20
    learner.learn(10, reset_num_timesteps=False)
    assert learner.dynamics.fits == [10, 20, 30]


def test_planning_that_fails_names_the_observation():
    learner = agent()
    learner.learn(13)
    learner.dynamics.resample = lambda data, generator: {"mean": learner.dynamics.mean.fill_(torch.nan).sum()}
    with pytest.raises(PlanningError, match=r"observation \[") as raised:
        learner.learn(10, reset_num_timesteps=False)
    assert len(learner.store) == 14
    assert str(learner._last_obs[0]) in str(raised.value)


def test_a_planner_of_a_shorter_horizon_than_its_use_is_refused():
    with pytest.raises(ValueError, match=r"actions_per_plan .*horizon 5\b.* 6$"):
        agent(actions_per_plan=6)
    assert planner().horizon == 5


def test_what_a_planner_of_double_precision_decides_is_stored_as_it_was_performed():
    bound, env = torch.tensor([2.0], dtype=torch.float64), KnownPointMass()
    cem = CEM(action_low=-bound, action_high=bound, horizon=5, num_candidates=40, num_elites=5, num_iterations=3)
    learner = MPCAgent(env, LinearModel(), cem, seed=0).learn(LENGTH + 5)
    assert learner.dynamics.fits == [LENGTH]
    np.testing.assert_array_equal(actions_of(env), learner.store.transitions().action.numpy())
