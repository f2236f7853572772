"""`dgpmpc` does what its help says, and says in one line what is wrong."""

import csv
import importlib.metadata
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import get_args

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import SAC
from typer.testing import CliRunner

from gym_dgpmpc import cli
from gym_dgpmpc.agents import DGPMPCAgent
from gym_dgpmpc.agents.exploration import ExplorationName
from gym_dgpmpc.agents.presets import NETWORKS, OF_A_TASK, PLANNING, mixture_settings_for, settings_for
from gym_dgpmpc.checkpoints.folder import RunCheckpoints
from gym_dgpmpc.checkpoints.format import read_checkpoint
from gym_dgpmpc.cli import options
from gym_dgpmpc.cli.request import fill_in
from gym_dgpmpc.dynamics.deep_gp.draws import DRAWS, REFRESHES
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.imagination.export import run_exported
from gym_dgpmpc.planning import PLANNERS, register_planner
from gym_dgpmpc.planning.registry import PlannerName
from gym_dgpmpc.planning.risk import RiskName
from gym_dgpmpc.runs import rendering
from tests.agents.point_mass import LENGTH
from tests.command_line import SMALLEST, dgpmpc, is_one_line_error
from tests.planning.toy_planners import RandomShooting
from tests.runs.toy import ENV_ID, ToyPush
from tests.tasks.test_goals import Goal


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Calls the command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return dgpmpc


@pytest.fixture
def drawable(monkeypatch):
    """The toy needs no OpenGL, and a process of its own would take seconds to find that out."""
    monkeypatch.setattr(rendering, "probe_rendering", lambda env_id: rendering.Rendering(True))


def test_train_and_evaluate(run, tmp_path, drawable):
    result = run("train", ENV_ID, *SMALLEST, "--episodes", 2, "--out", "a")
    assert result.exit_code == 0, result.output
    assert len(re.findall(r"^episode +\d", result.stdout, re.MULTILINE)) == 3
    assert "return of 2 planned episodes: mean" in result.stdout
    assert "next: dgpmpc evaluate a" in result.stdout
    assert {path.name for path in (tmp_path / "a").iterdir()} == {
        ".lock",
        "agent.previous.zip",
        "agent.zip",
        "episodes.csv",
        "last_episode.gif",
        "learning_curve.png",
        "prediction_fan.npz",
        "prediction_fan.png",
        "settings.json",
        "tensorboard",
    }
    rows = list(csv.DictReader((tmp_path / "a" / "episodes.csv").open()))
    assert [row["actions"] for row in rows] == ["random", "planned", "planned"]
    settings = json.loads((tmp_path / "a" / "settings.json").read_text())["settings"]
    assert settings["num_candidates"] == 6
    assert settings["kernel"] == "matern32"

    result = run("evaluate", "a", "--env", ENV_ID, "--episodes", 2, "--video", "b.gif")
    assert result.exit_code == 0, result.output
    assert len(re.findall(r"^episode +\d", result.stdout, re.MULTILINE)) == 2
    assert "mean return" in result.stdout
    assert (tmp_path / "b.gif").stat().st_size > 0
    assert run("evaluate", "a/agent.zip", "--episodes", 2).stdout.splitlines()[:3] == result.stdout.splitlines()[:3]


def test_the_seed_of_an_evaluation_decides_its_starting_states(run):
    assert run("train", ENV_ID, *SMALLEST, "--no-video", "--episodes", 1, "--out", "a").exit_code == 0
    played = [run("evaluate", "a", "--episodes", 2, "--seed", seed) for seed in (1, 2, 1)]
    assert all(result.exit_code == 0 for result in played)
    first, second, again = (re.findall(r"return +(\S+)$", result.stdout, re.MULTILINE)[:2] for result in played)
    assert len(first) == 2
    assert first == again
    assert set(first).isdisjoint(second)


def test_the_same_command_goes_on_or_says_that_it_is_done(run):
    command = ("train", ENV_ID, *SMALLEST, "--no-video", "--out", "a")
    assert run(*command, "--episodes", 1).exit_code == 0
    done = run(*command, "--episodes", 1)
    assert done.exit_code == 0
    assert "finished" in done.stdout
    more = run(*command, "--episodes", 2)
    assert more.exit_code == 0
    assert "goes on after step 24" in more.stdout
    assert is_one_line_error(run(*command, "--seed", 1), "seed was 0, now 1", "--overwrite")
    assert run(*command, "--seed", 1, "--episodes", 1, "--overwrite").exit_code == 0


def test_timesteps_and_default_folder(run, tmp_path):
    result = run("train", ENV_ID, *SMALLEST, "--no-video", "--timesteps", 20, "--seed", 3)
    assert result.exit_code == 0, result.output
    assert "20 environment steps" in result.stdout
    assert (tmp_path / "runs" / "ToyPush-v0-seed3" / "agent.zip").exists()


def test_settings_of_a_stock_task_are_taken_unless_others_are_asked_for(run, tmp_path):
    result = run("train", "Pendulum-v1", "--no-video", "--timesteps", 2, "--candidates", 50, "--out", "a")
    assert result.exit_code == 0, result.output
    settings = json.loads((tmp_path / "a" / "settings.json").read_text())["settings"]
    expected = {**settings_for("Pendulum-v1"), "num_candidates": 50}
    assert expected == {name: settings[name] for name in expected}


def test_same_seed_same_run(run, tmp_path):
    for out in ("a", "b"):
        assert run("train", ENV_ID, *SMALLEST, "--no-video", "--episodes", 1, "--out", out).exit_code == 0
    returns = [
        [row["episode_return"] for row in csv.DictReader((tmp_path / out / "episodes.csv").open())] for out in "ab"
    ]
    assert returns[0] == returns[1]


def test_without_opengl_only_the_video_is_missing(run, tmp_path, monkeypatch):
    monkeypatch.setattr(rendering, "probe_rendering", lambda env_id: rendering.Rendering(False, None, "no GL: get it"))
    result = run("train", ENV_ID, *SMALLEST, "--episodes", 1, "--out", "a")
    assert result.exit_code == 0, result.output
    assert "no GIF: no GL: get it\n" in result.stdout
    assert not (tmp_path / "a" / "last_episode.gif").exists()
    assert (tmp_path / "a" / "learning_curve.png").exists()
    result = run("evaluate", "a", "--episodes", 1, "--video", "b.gif")
    assert result.exit_code == 0, result.output
    assert "no GIF: no GL: get it\n" in result.stdout


def test_interruption(run, monkeypatch):
    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(DGPMPCAgent, "learn", interrupt)
    result = run("train", ENV_ID, *SMALLEST, "--no-video", "--out", "a")
    assert result.exit_code == 130
    assert "the same command goes on" in result.stdout


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_end_a_run_with_their_exit_codes(run, tmp_path, monkeypatch, number, code):
    command = ("train", ENV_ID, *SMALLEST, "--no-video", "--out", "a", "--episodes", 3, "--checkpoint-every", 5)
    step = ToyPush.step

    def step_with_signal(self, action):
        if self.time == 3 and (tmp_path / "a" / "agent.previous.zip").exists():  # after an episode
            os.kill(os.getpid(), number)
        return step(self, action)

    monkeypatch.setattr(ToyPush, "step", step_with_signal)
    result = run(*command)
    assert result.exit_code == code, result.output
    assert "the same command goes on from the checkpoint in a" in result.stdout
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    result = run(*command)
    assert result.exit_code == 0, result.output
    assert "goes on after step 16" in result.stdout
    assert "return of 3 planned episodes" in result.stdout


def test_a_folder_in_use_and_a_failing_environment_are_one_line(run, tmp_path, monkeypatch):
    command = ("train", ENV_ID, *SMALLEST, "--no-video", "--out", "a", "--episodes", 2)
    with RunCheckpoints(tmp_path / "a"):
        assert is_one_line_error(run(*command), "in use by process")
    step = ToyPush.step

    def failing(self, action):
        if self.time == 5 and (tmp_path / "a" / "agent.previous.zip").exists():  # after an episode
            raise ConnectionError("the plant is gone")
        return step(self, action)

    monkeypatch.setattr(ToyPush, "step", failing)
    assert is_one_line_error(run(*command), "step 17: the environment's step raised ConnectionError: the plant is gone")
    monkeypatch.setattr(ToyPush, "step", step)
    result = run(*command)
    assert result.exit_code == 0, result.output
    assert "goes on after step 17" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["NoSuchEnv-v0"], ["NoSuchEnv"]),
        (["no_such_module:Env-v0"], ["no_such_module"]),
        (["CartPole-v1"], ["action spaces", "Discrete"]),
        (["ToyPushForever-v0"], ["no time limit", "--timesteps"]),
        (["ToyPush-v0", "--episodes", "1", "--timesteps", "5"], ["either --episodes or --timesteps"]),
        (["ToyPush-v0", "--candidates", "5", "--elites", "6"], ["6"]),
        (["ToyPush-v0", "--horizon", "2", "--actions-per-plan", "3"], ["horizon 2", "got 3"]),
    ],
)
def test_train_says_what_is_wrong(run, tmp_path, arguments, texts):
    assert is_one_line_error(run("train", *arguments, "--no-video"), *texts)
    assert [path for path in tmp_path.rglob("*.*") if path.name != ".lock"] == []


def test_a_reward_that_nobody_knows_is_learned(run, drawable):
    result = run("train", "ToyPushWithoutReward-v0", *SMALLEST, "--episodes", 1, "--out", "a")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("reward: learned | termination: learned, once an episode has terminated\n")
    evaluated = run("evaluate", "a", "--episodes", 1)
    assert evaluated.exit_code == 0, evaluated.output


def test_what_is_known_is_learned_when_asked(run):
    command = ("train", ENV_ID, *SMALLEST, "--episodes", 1, "--no-video", "--out", "a")
    result = run(*command, "--reward-fn", "learned", "--terminated-fn", "learned")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("reward: learned | termination: learned, once an episode has terminated\n")
    assert read_checkpoint("a/agent.zip").config["values"]["task"]["reward"]
    assert is_one_line_error(run(*command), "reward_fn was learned, now None")


def test_a_task_with_a_goal(run):
    """Its observations are dicts; its forecasts, figures and rows are those of vectors."""
    gymnasium.register("GoalOfTheTests-v0", Goal, max_episode_steps=LENGTH)
    try:
        result = run("train", "GoalOfTheTests-v0", *SMALLEST, "--episodes", 1, "--no-video", "--out", "a")
        assert result.exit_code == 0, result.output
        assert "prediction_fan.png" in result.stdout
        assert run("evaluate", "a", "--episodes", 1).exit_code == 0
    finally:
        del gymnasium.registry["GoalOfTheTests-v0"]


def test_a_task_in_a_module_that_lies_in_the_folder(run, tmp_path, monkeypatch):
    (tmp_path / "mine_of_the_tests.py").write_text(
        "import gymnasium\nfrom tests.runs.toy import ToyPush\n\n\nclass Mine(ToyPush):\n    pass\n\n\n"
        'gymnasium.register("Mine-v0", Mine, max_episode_steps=12)\n'
    )
    monkeypatch.setattr(sys, "path", [*sys.path])
    try:
        command = ("train", "mine_of_the_tests:Mine-v0", *SMALLEST, "--episodes", 1, "--no-video", "--out", "a")
        result = run(*command)
        assert result.exit_code == 0, result.output
        del gymnasium.registry["Mine-v0"], sys.modules["mine_of_the_tests"]  # as in a process of its own
        assert run("evaluate", "a", "--episodes", 1).exit_code == 0
        assert is_one_line_error(run("train", "no_such_module:Mine-v0"), "needs the Python module no_such_module")
    finally:
        gymnasium.registry.pop("Mine-v0", None)
        sys.modules.pop("mine_of_the_tests", None)


def test_a_task_without_end(run):
    often = ["--timesteps", 30, "--learning-starts", 8, "--train-freq", 9, "--no-video", "--out", "a"]
    assert run("train", "ToyPushForever-v0", *SMALLEST, *often).exit_code == 0
    checkpoint = read_checkpoint("a/agent.zip")
    assert checkpoint.config["values"]["progress"]["num_fitted"] == 26


def test_an_error_without_words_says_where_it_was(run, monkeypatch):
    def fail(*args, **kwargs):
        raise AssertionError

    monkeypatch.setattr(ToyPush, "__init__", fail)
    assert is_one_line_error(
        run("train", "ToyPush-v0", "--no-video"), "AssertionError at ", "test_cli.py", "raise AssertionError"
    )


@pytest.mark.parametrize(
    ("option", "name"),
    [
        ("--kernel=linear", "--kernel"),
        ("--draw=x", "--draw"),
        ("--planner=x", "--planner"),
        ("--episodes=0", "--episodes"),
        ("--seed=-1", "--seed"),
        ("--layers=two", "--layers"),
        ("--num-layers=0", "num_layers"),
        ("--candidates=0", "num_candidates"),
        ("--time-budget=-1", "time_budget"),
    ],
)
def test_limits_of_options(run, option, name):
    result = run("train", ENV_ID, option, "--no-video")
    assert result.exit_code == 2
    assert name in result.stderr


def test_a_policy_is_distilled_from_a_run(run, tmp_path):
    assert run("train", ENV_ID, *SMALLEST, "--episodes", 1, "--no-video", "--out", "a").exit_code == 0
    few = ("--timesteps", 40, "--trial-every", 20, "--worlds", 2)
    result = run("distil", "a", *few, "--export", "a/policy.pt", "--episodes", 1)
    assert result.exit_code == 0, result.output
    assert len(re.findall(r"^ +\d+ imagined steps \| return in held-out worlds", result.stdout, re.MULTILINE)) == 2
    assert (
        "return in fresh worlds" in result.stdout and "in the environment: mean return of 1 episodes" in result.stdout
    )
    model = SAC.load(tmp_path / "a/policy.zip", device="cpu")
    observation = np.zeros(model.observation_space.shape, np.float32)
    acted = run_exported(tmp_path / "a/policy.pt", observation[None])
    np.testing.assert_allclose(acted[0], model.predict(observation, deterministic=True)[0], atol=1e-5)
    # What is wrong is said before anything is trained.
    assert is_one_line_error(run("distil", "a", *few, "--export", "policy.h5"), ".pt or .onnx", "policy.h5")
    assert is_one_line_error(run("distil", "a", *few, "--algorithm", "DQN"), "algorithm must be one of", "DQN")
    assert is_one_line_error(run("distil", "b"), "no file b")


def test_evaluate_says_what_is_wrong(run, tmp_path):
    assert is_one_line_error(run("evaluate", "nothing.zip"), "expected a folder of `dgpmpc train`", "nothing.zip")
    assert is_one_line_error(run("evaluate", "."), "agent.zip")
    (tmp_path / "text.zip").write_text("no agent")
    assert is_one_line_error(run("evaluate", "text.zip"), "text.zip")
    run("train", ENV_ID, *SMALLEST, "--no-video", "--episodes", 1, "--out", "a")
    assert is_one_line_error(run("evaluate", "a", "--env", "ModCartPole-v0"), "saved for observations")


def test_version_and_help(run):
    version = run("--version")
    assert version.exit_code == 0
    assert version.stdout == f"dgpmpc {importlib.metadata.version('gym-dgpmpc')}\n"
    for command in ([], ["train"], ["evaluate"], ["bench"]):
        shown = run(*command, "--help")
        assert shown.exit_code == 0
        assert "Usage" in shown.stdout


def test_help_does_not_wait_for_pytorch():
    script = "import sys, gym_dgpmpc.cli; sys.exit('torch' in sys.modules or 'mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0


def test_an_agent_does_not_wait_for_what_its_training_needs():
    slow = ("scipy.cluster", "scipy.optimize")
    script = f"import sys; from gym_dgpmpc import DGPMPCAgent; sys.exit(any(name in sys.modules for name in {slow}))"
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0


def test_runs_as_a_module():
    result = subprocess.run([sys.executable, "-m", "gym_dgpmpc", "--version"], capture_output=True, text=True)
    assert result.stdout.startswith("dgpmpc ")


@pytest.mark.parametrize("agent", options.AGENTS)
def test_every_plain_setting_is_an_option(run, agent):
    """Called as it is, with what it means; `--help` shows the default or says that the preset decides."""
    shown = re.sub(r"[\s│]+", " ", run_wide("train", "--agent", agent, "--help"))
    agent_class, settings_for = options.AGENTS[agent]
    settings = {**agent_class.own_settings(), **agent_class.part_settings("cem")}
    plain = [name for name, setting in settings.items() if setting.annotation in (int, float, bool, str)]
    assert len(plain) > 15
    for name in set(plain) - options.SET_BY_THE_RUN:
        assert f"--{name.replace('_', '-')}" in shown
        preset = any(name in settings_for(env_id) for table in (*OF_A_TASK, NETWORKS) for env_id in table)
        assert f"{settings[name].default}{' or the preset' if preset else ''}" in shown
    for name, choices in {"kernel": KERNELS, "draw": DRAWS, "refresh": REFRESHES, "planner": PLANNERS}.items():
        is_there = name == "planner" or any(each.endswith(name) for each in settings)
        assert ("|".join(choices) in shown) == is_there


def test_the_preset_chooses_the_planner_unless_another_is_asked_for():
    better = PLANNING["ModCartPole-v0"]
    filled = fill_in(
        "ModCartPole-v0", {"planner": None, "noise_beta": None, "exploration": None, "num_candidates": None}
    )
    assert filled == {**filled, **better, "num_candidates": 300}
    asked = {"planner": "cem", "noise_beta": None, "exploration": None, "smoothing": None}
    assert "noise_beta" not in fill_in("ModCartPole-v0", asked)
    shown = re.sub(r"[\s│]+", " ", run_wide("train", "--help"))
    assert "[default: (cem or the preset's for ENV_ID)]" in shown


def run_wide(*arguments):
    return CliRunner().invoke(cli.app, [*arguments], env={"COLUMNS": "400"}).stdout


def test_a_missing_extra_is_named(run, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("gymnasium_robotics")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "gym_dgpmpc.envs.robotics", raising=False)
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)  # as if it was not installed
    result = run("train", "gym_dgpmpc.envs.robotics:FetchReachDense-v4", "--no-video")
    assert is_one_line_error(result, "module gymnasium_robotics:", 'pip install "gym-dgpmpc[robotics]"')


def test_short_and_long_names_of_an_option_are_the_same(run):
    for layers in ("--layers", "--num-layers"):
        out = f"a{layers}"
        result = run("train", ENV_ID, *SMALLEST, layers, 2, "--episodes", 1, "--no-video", "--out", out)
        assert result.exit_code == 0, result.output
        assert read_checkpoint(f"{out}/agent.zip").config["arguments"]["num_layers"] == 2


def test_any_registered_planner(run):
    register_planner("shooting", RandomShooting)
    try:
        sizes = [option for option in SMALLEST if "--iterations" not in option]
        command = ("train", ENV_ID, *sizes, "--planner", "shooting", "--episodes", 1, "--no-video", "--out", "a")
        result = run(*command)
        assert result.exit_code == 0, result.output
        assert read_checkpoint("a/agent.zip").config["arguments"]["planner"] == "shooting"
        assert run("evaluate", "a", "--episodes", 1).exit_code == 0
        assert is_one_line_error(run(*command, "--smoothing", 0.5), "shooting", "smoothing")
        assert is_one_line_error(run("train", ENV_ID, *SMALLEST, "--no-video", "--out", "a"), "planner", "cem")
    finally:
        del PLANNERS["shooting"]


def test_planner_risk_and_exploration_are_options(run):
    options = ["--planner=icem", "--noise-beta=2", "--risk=cvar", "--cvar-share=0.5", "--exploration=coloured"]
    command = ("train", ENV_ID, *SMALLEST, "--episodes", 1, "--no-video", "--out", "a")
    result = run(*command, *options, "--exploration-beta=0.5")
    assert result.exit_code == 0, result.output
    arguments = read_checkpoint("a/agent.zip").config["arguments"]
    expected = {"planner": "icem", "noise_beta": 2.0, "risk": "cvar", "cvar_share": 0.5, "exploration": "coloured"}
    assert {**arguments, **expected, "exploration_beta": 0.5} == arguments
    assert run("evaluate", "a", "--episodes", 1).exit_code == 0
    assert is_one_line_error(run(*command, *options), "exploration_beta was 0.5, now 1.0")
    assert is_one_line_error(run(*command, "--planner=cem", "--noise-beta=2"), "plans by cem", "noise_beta")
    shown = re.sub(r"[\s│]+", " ", run_wide("train", "--help"))
    for choices in (PlannerName, RiskName, ExplorationName):
        assert "|".join(get_args(choices)) in shown


def test_a_mixture_of_models(run, drawable):
    """Its members' settings are options under their names; the presets are theirs too."""
    command = ("train", ENV_ID, "--agent=mixture", "--episodes=1", "--out=a", "--candidates=6", "--iterations=1")
    members = ("--members=sparse-gp", "--members=ensemble", "--sparse-gp-num-inducing=4", "--ensemble-num-epochs=2")
    result = run(*command, *members)
    assert result.exit_code == 0, result.output
    checkpoint = read_checkpoint("a/agent.zip").config
    assert checkpoint["class"] == "MixtureMPCAgent"
    arguments = checkpoint["arguments"]
    assert (arguments["members"], arguments["ensemble_num_epochs"]) == (["sparse-gp", "ensemble"], 2)
    assert run("evaluate", "a", "--episodes", 1).exit_code == 0
    assert is_one_line_error(run(*command), "members was ['sparse-gp', 'ensemble'], now ['deep-gp', 'ensemble']")
    assert is_one_line_error(run("train", ENV_ID, "--out=a"), "agent was mixture, now dgp-mpc")
    assert is_one_line_error(run(*command, "--layers=2"), "mixture", "num_layers", "deep_gp_num_layers")
    env_id = "VelocityHalfCheetah-v0"
    preset = mixture_settings_for(env_id)
    assert fill_in(env_id, dict.fromkeys(preset), "mixture") == {**preset, "planner": "cem"}


def test_a_run_from_before_a_setting_existed_goes_on(run):
    command = ("train", ENV_ID, *SMALLEST, "--no-video", "--out", "a")
    assert run(*command, "--episodes", 1).exit_code == 0
    content = json.loads(Path("a/settings.json").read_text())
    for name in ("agent", "planner", "smoothing", "risk", "exploration_hold"):
        del content["settings"][name]
    Path("a/settings.json").write_text(json.dumps(content))
    result = run(*command, "--episodes", 2)
    assert result.exit_code == 0, result.output
    assert is_one_line_error(run(*command, "--smoothing", 0.5), "smoothing was 0.1, now 0.5")
