"""The suites hold what they should, and can be narrowed."""

import importlib
import shlex
from collections import Counter
from pathlib import Path

import gymnasium
import pytest

from benchmarks.methods import METHODS, dgp_mpc
from benchmarks.paper import EPISODES as PAPER_TASKS
from benchmarks.paper import KERNELS
from benchmarks.suites import AT_THEIR_BEST, SUITES, Selection, SuiteError, find_suite
from benchmarks.tasks import TASKS
from gym_dgpmpc.agents.presets import COMPARISON_PETS, PAPER, PETS, PLANNING

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
RUN_SUITES = ("table", "comparison", "variance", "unmodified", "long-cheetah", "stock")


def jobs(name, **selection):
    return find_suite(name).jobs(Selection(**selection))


@pytest.mark.parametrize("name", RUN_SUITES)
def test_every_run_is_of_a_method_and_a_task_that_there_are(name):
    runs = jobs(name)
    assert len({run.file_name for run in runs}) == len(runs)
    for run in runs:
        assert run.task is TASKS[run.task.name]
        assert run.settings == METHODS[run.method].settings(run.task)


@pytest.mark.parametrize("name", RUN_SUITES)
def test_the_command_of_a_run_makes_that_run(name):
    for run in jobs(name, seeds=[3], episodes=2):
        program, command, suite, *options = shlex.split(run.command)
        assert (program, command) == ("dgpmpc", "bench")
        given = dict(zip(options[::2], options[1::2], strict=True))
        assert jobs(
            suite,
            seeds=[int(given["--seeds"])],
            tasks=[given["--tasks"]],
            methods=[given["--methods"]],
            episodes=int(given["--episodes"]),
        ) == [run]


def test_the_table_is_12_settings_on_3_tasks_with_10_seeds():
    runs = jobs("table")
    cells = Counter((run.task.name, run.settings["num_layers"], run.settings["kernel"]) for run in runs)
    assert set(cells) == {(task, layers, kernel) for task in PAPER_TASKS for layers in (1, 2, 3) for kernel in KERNELS}
    assert set(cells.values()) == {10}
    for run in runs:
        assert run.episodes == (10 if "Cheetah" in run.task.name else 15)
        for name, value in PAPER[run.task.name].items():
            assert run.settings[name] == value


def test_the_comparison_plans_alike_and_learns_from_as_many_steps():
    runs = jobs("comparison", seeds=[0])
    assert {run.task.name for run in runs} == set(PAPER_TASKS)
    assert {run.method for run in runs} == {
        "DGP-MPC L=2 matern32", "DGP-MPC L=3 matern32", "PETS TS1", "PETS TSinf", "GP-MM", "GP-DS", "SAC", "TD3",
        "PPO", "true dynamics",
    }  # fmt: skip
    for run in runs:
        paper = PAPER[run.task.name]
        if METHODS[run.method].is_model_free:
            assert run.max_steps == (1 + run.episodes) * run.task.episode_steps
            assert run.settings.get("learning_starts", run.task.episode_steps) == run.task.episode_steps
            continue
        for name in ("horizon", "num_candidates", "num_elites", "num_iterations", "actions_per_plan"):
            assert run.settings[name] == paper[name]
        if "num_particles" in run.settings:
            assert run.settings["num_particles"] == paper["num_particles"]
        if run.method.startswith("PETS"):
            assert run.settings["hidden_size"] == COMPARISON_PETS[run.task.name]["hidden_size"]
            assert run.settings["draw"] == run.method.split()[1]
        if run.method.startswith("GP-"):
            assert run.settings["draw"] == run.method[3:]
            assert run.settings["num_inducing"] == 200


def test_the_variance_is_of_the_runs_of_the_comparison():
    names = {run.file_name for run in jobs("comparison")}
    variance = {run.file_name for run in jobs("variance")}
    assert variance == {name for name in names if "true-dynamics" not in name}


def test_the_other_suites():
    unmodified = jobs("unmodified", seeds=[0])
    assert [(run.task.name, run.method) for run in unmodified] == [
        ("SwingUpCartPole-v0", method)
        for method in ("DGP-MPC L=1 rbf", "DGP-MPC L=2 rbf", "DGP-MPC L=3 rbf", "PETS as published")
    ]
    published = unmodified[-1].settings
    assert {name: published[name] for name in PETS["SwingUpCartPole-v0"]} == PETS["SwingUpCartPole-v0"]

    long = jobs("long-cheetah", seeds=[0])
    assert {run.episodes for run in long} == {50}
    # Its files are its own, or the table would mix runs of 10 and of 50 episodes.
    assert not {run.file_name for run in long} & {run.file_name for run in jobs("table")}
    assert {run.settings["horizon"] for run in long} == {40}

    stock = jobs("stock", seeds=[0])
    planned = {run.task.name: run for run in stock if run.method != "SAC"}
    model_free = {run.task.name: run for run in stock if run.method == "SAC"}
    assert set(planned) == {*model_free, "Pendulum-v1:learned reward"}
    assert planned["Pendulum-v1:learned reward"].settings["reward_fn"] == "learned"
    assert all(run.max_steps == 10 * planned[name].max_steps for name, run in model_free.items())
    assert {run.steps_of for run in model_free.values()} == {run.method for run in planned.values()}


@pytest.mark.parametrize("name", sorted(TASKS))
def test_tasks_are_as_registered(name):
    task = TASKS[name]
    module, _, env_id = (task.env_id or name.partition(":")[0]).rpartition(":")
    if module:
        importlib.import_module(module)
    assert gymnasium.spec(env_id).max_episode_steps == task.episode_steps


def test_a_suite_is_narrowed_by_names_and_patterns():
    runs = jobs("comparison", seeds=[7, 5], tasks=["*CartPole*"], methods=["PETS*", "SAC"], episodes=4)
    assert [(run.seed, run.method, run.episodes) for run in runs] == [
        (seed, method, 4) for seed in (7, 5) for method in ("PETS TS1", "PETS TSinf", "SAC")
    ]


@pytest.mark.parametrize(
    ("suite", "selection", "message"),
    [
        ("table", {"tasks": ["Pendulum-v1"]}, "'Pendulum-v1'.*BiasedReacher-v0"),
        ("table", {"methods": ["SAC"]}, "'SAC'.*DGP-MPC L=1 matern12"),
        ("stock", {"tasks": ["*learned*"], "methods": ["SAC"]}, r"\['SAC'\]"),
        ("tables", {}, "'tables'.*table, comparison"),
    ],
)
def test_what_a_suite_does_not_have(suite, selection, message):
    with pytest.raises(SuiteError, match=message):
        jobs(suite, **selection)


def test_results_are_found_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert [SUITES[name].results for name in ("table", "contact")] == [RESULTS / "runs", RESULTS / "contact"]


def test_all_that_are_at_their_best_plan_alike_and_the_others_as_the_paper():
    runs = jobs("fair", seeds=[20], tasks=["ModCartPole-v0"])
    planners = {run.method: run.settings["planner"] for run in runs if not METHODS[run.method].is_model_free}
    better = {name for name, planner in planners.items() if planner == "icem"}
    assert better == AT_THEIR_BEST - {dgp_mpc(1, "matern32")} and set(planners) - better == {"PETS TSinf", "GP-MM"}
    for run in runs:
        if run.method in better:
            assert run.settings == {**run.settings, **PLANNING["ModCartPole-v0"]}
    for name in ("table", "comparison", "variance", "unmodified"):
        others = jobs(name, seeds=[0])
        assert {run.settings.get("planner", "cem") for run in others} == {"cem"}


def test_on_the_reacher_those_climb_whose_draws_are_functions():
    runs = [
        run for run in jobs("fair", seeds=[20], tasks=["BiasedReacher-v0"]) if not METHODS[run.method].is_model_free
    ]
    climbing = {run.method for run in runs if run.settings["planner"] == "gradient"}
    assert climbing == {dgp_mpc(layers, "matern32") for layers in (1, 2, 3)}
    assert {run.settings["planner"] for run in runs if run.method not in climbing} == {"cem"}


def test_the_committed_fair_runs_are_those_of_the_suite():
    fair = find_suite("fair")
    done = [run for run in fair.jobs(Selection(tasks=["ModCartPole-v0"])) if run.is_finished(fair.results)]
    assert len(done) >= 20 and {run.method for run in done} <= AT_THEIR_BEST | {"PETS TSinf", "GP-MM"}
