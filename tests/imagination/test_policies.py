"""Policies from imagination: chosen by held-out worlds, repeatable, without a trace elsewhere, and by themselves."""

import random
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import DDPG, SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure

from gym_dgpmpc.errors import TrainingError
from gym_dgpmpc.imagination import policies
from gym_dgpmpc.imagination.algorithms import algorithm_class, budget_of, suited_settings
from gym_dgpmpc.imagination.features import EncodedObservation
from gym_dgpmpc.imagination.global_randomness import lent_randomness
from gym_dgpmpc.imagination.policies import ChooseByWorlds, Trial, imagine, learned_parameters, moved, take_over
from gym_dgpmpc.imagination.worlds import ImaginedVecEnv
from tests.agents.point_mass import LENGTH, KnownPointMass, agent

QUICK = {
    "num_worlds": 4,
    "episode_steps": LENGTH,
    "trial_every": 100,
    "seed": 0,
    "policy_kwargs": {"net_arch": [16]},
    "batch_size": 32,
}


@pytest.fixture(scope="module")
def learned():
    return agent().learn(25)


@pytest.fixture(scope="module")
def imagined(learned):
    return imagine(learned, "SAC", 600, patience=50, learning_rate=3e-3, encoded=False, **QUICK)


def test_it_gets_better_at_the_real_task(learned, imagined):
    idle = SimpleNamespace(predict=lambda o, state, episode_start, deterministic: (np.zeros((len(o), 1)), None))
    returns = [evaluate_policy(one, learned.env, 5, warn=False)[0] for one in (idle, imagined.model)]
    assert returns[1] > returns[0] + 1.0  # at rest, a mass at 0.5 to 1 loses 2.5 to 10


def test_the_best_of_the_trials_is_kept(learned, imagined):
    trials = imagined.trials
    assert [trial.timesteps for trial in trials] == [100, 200, 300, 400, 500, 600]
    assert imagined.best == max(trials, key=lambda trial: trial.mean_return)
    held_out = ImaginedVecEnv.of(learned, 4, episode_steps=LENGTH, starts="starts", seed=0)
    seed = policies.derive_seed(0, "imagination", policies.CHOOSING)
    assert Trial.of(imagined.model, held_out, seed, 0).mean_return == imagined.best.mean_return
    assert imagined.fresh.mean_return != imagined.best.mean_return and imagined.model.env is None


def test_the_seed_decides_everything_and_nothing_else_is_moved(learned, imagined):
    numbers, own = np.random.get_state()[1].tolist(), torch.get_rng_state()  # noqa: NPY002
    planning = learned.generators.planning.get_state()
    model = learned.imagine_policy("SAC", 600, patience=50, learning_rate=3e-3, encoded=False, **QUICK)
    for one, other in zip(model.policy.parameters(), imagined.model.policy.parameters(), strict=True):
        assert torch.equal(one, other)
    assert np.random.get_state()[1].tolist() == numbers and torch.equal(torch.get_rng_state(), own)  # noqa: NPY002
    assert torch.equal(learned.generators.planning.get_state(), planning)
    other = learned.imagine_policy("SAC", 100, **{**QUICK, "seed": 1})
    assert not torch.equal(next(model.policy.parameters()), next(other.policy.parameters()))


def test_pythons_own_random_state_is_put_back_too():
    # Not looked at above, for the checks of annotations draw from it.
    before = random.getstate()
    with pytest.raises(RuntimeError), lent_randomness():
        random.seed(5)
        raise RuntimeError
    assert random.getstate() == before


def test_the_average_moves_and_counters_do_not():
    """After x, y and z with a share of a quarter it is (x 3/4 + y 1/4) 3/4 + z 1/4."""
    average: dict[str, torch.Tensor] = {}
    for number in (8.0, 16.0, 40.0):
        average = moved(average, {"w": torch.tensor([number]), "steps": torch.tensor(int(number))}, 0.25)
    assert average["w"].tolist() == [17.5] and average["steps"].item() == 40


def test_what_is_tried_and_kept_is_the_average_and_what_learns_is_not(learned, monkeypatch):
    def first_bias():
        return next(value for name, value in model.policy.named_parameters() if name.endswith("bias"))

    tried, returns = [], iter([1.0, 3.0, 2.0])

    def note(model, worlds, seed, timesteps):
        tried.append(first_bias()[0].item())
        return Trial(timesteps, next(returns), 0.0)

    monkeypatch.setattr(Trial, "of", note)
    worlds = ImaginedVecEnv.of(learned, 4, episode_steps=LENGTH, seed=0)
    model = SAC("MlpPolicy", worlds, device="cpu")
    chosen = ChooseByWorlds(worlds, 0, 100, 50, None, None)
    chosen.init_callback(model)
    model.set_logger(configure(None, []))
    for number in (1.0, 2.0, 3.0):
        first_bias().data.fill_(number)
        chosen.try_policy()
        assert (first_bias() == number).all()  # it goes on from its own
    share = policies.LATEST
    second = 1.0 + share
    assert tried == pytest.approx([1.0, second, second + share * (3.0 - second)], rel=1e-6)
    assert chosen.restore_best().mean_return == 3.0 and first_bias()[0].item() == tried[1]


def test_training_ends_when_nothing_gets_better(learned, monkeypatch):
    returns = iter([1.0, 3.0, 2.0, 2.5, 9.0])
    monkeypatch.setattr(Trial, "of", lambda model, worlds, seed, timesteps: Trial(timesteps, next(returns), 0.0))
    seen = []
    found = imagine(learned, "SAC", 2_000, patience=2, on_trial=seen.append, learning_starts=10**6, **QUICK)
    assert [trial.mean_return for trial in seen] == [1.0, 3.0, 2.0, 2.5] == [t.mean_return for t in found.trials]
    assert found.best.timesteps == 200 and found.fresh.mean_return == 9.0


def test_the_last_policy_is_tried_too(learned):
    found = imagine(learned, "SAC", 150, learning_starts=10**6, **QUICK)
    assert [trial.timesteps for trial in found.trials] == [100, 152]  # whole steps of four worlds


def test_a_policy_that_is_not_finite_is_never_returned(learned, monkeypatch):
    monkeypatch.setattr(Trial, "of", lambda model, worlds, seed, timesteps: Trial(timesteps, float("nan"), 0.0))
    with pytest.raises(TrainingError, match="of 2 trials none had a finite return"):
        imagine(learned, "SAC", 1_000, patience=2, learning_starts=10**6, **QUICK)


def test_its_file_needs_nothing_of_this_package(imagined, tmp_path):
    path = tmp_path / "policy.zip"
    imagined.model.save(path)
    observation = np.array([0.7, -0.1])
    action = imagined.model.predict(observation, deterministic=True)[0]
    program = (
        "import sys; sys.modules['gym_dgpmpc'] = None\n"
        "import numpy; from stable_baselines3 import SAC\n"
        f"print(SAC.load({str(path)!r}, device='cpu').predict(numpy.array([0.7, -0.1]), deterministic=True)[0].item())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert float(done.stdout) == action.item()
    on = SAC.load(path, env=KnownPointMass(), device="cpu").learn(120)  # and can be trained on, in the real environment
    assert on.num_timesteps == 120


def test_what_was_learned_is_taken_over(learned, imagined):
    went_on = imagine(learned, "SAC", 100, begin_with=imagined.model, learning_starts=10**6, encoded=False, **QUICK)
    for one, other in zip(went_on.model.policy.parameters(), imagined.model.policy.parameters(), strict=True):
        assert torch.equal(one, other)
    parameters = learned_parameters(imagined.model)
    assert parameters["log_ent_coef"] != 0.0
    with pytest.raises(RuntimeError):
        take_over(DDPG("MlpPolicy", KnownPointMass(), device="cpu"), parameters)


def test_algorithms_by_name():
    assert algorithm_class("SAC") is SAC and algorithm_class(DDPG) is DDPG
    assert algorithm_class("CrossQ").__module__.startswith("sb3_contrib")
    with pytest.raises(ValueError, match=r"gradient, SAC, TD3, DDPG, PPO, A2C, TQC, CrossQ, or a class .* got 'DQN'"):
        algorithm_class("DQN")


def test_settings_that_suit_worlds():
    box, features = spaces.Box(-1, 1, (2,)), {"features_extractor_class": EncodedObservation}
    of_vectors = suited_settings(SAC, 20, 1_000, box, features)
    assert of_vectors["policy"] == "MlpPolicy" and features.items() <= of_vectors["policy_kwargs"].items()
    of_dicts = suited_settings(SAC, 1, 1_000, spaces.Dict({"a": box}), features)
    assert of_dicts["policy"] == "MultiInputPolicy" and of_dicts["gradient_steps"] == 1
    assert "features_extractor_class" not in of_dicts["policy_kwargs"]


def test_the_budget_is_the_algorithms_own():
    budgets = {kind: budget_of(algorithm_class(kind)) for kind in ("gradient", "SAC", "PPO")}
    assert len(set(budgets.values())) == 3 and all(b.total_timesteps > 10 * b.trial_every for b in budgets.values())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"trial_every": 0}, "trial_every must be at least 1, got 0"), ({"wings": 2}, "wings")],
)
def test_wrong_arguments_are_named(learned, wrong, message):
    with pytest.raises((ValueError, TypeError), match=message):
        learned.imagine_policy("SAC", 100, **wrong)


def test_steps_are_reported_as_they_come(learned):
    steps, worlds = [], ImaginedVecEnv.of(learned, 4, episode_steps=LENGTH, seed=0)
    callback = ChooseByWorlds(worlds, 0, 10**9, 1, None, steps.append)
    SAC("MlpPolicy", worlds, learning_starts=10**6, device="cpu").learn(12, callback)
    assert steps == [4, 4, 4]
