"""Budgets by name, for every method that trains: from the word on the command line to the steps that its networks were trained."""

from pathlib import Path

import pytest

from pipeline.config import BUDGETS, parse_config
from pipeline.experiment import Choices, resolve_target
from pipeline.folds import PolicyTask, split_of, train_fold
from pipeline.methods import METHODS
from tests.hand_made import STATE_ONLY, random_walks, semantics
from tests.policies.test_methods import NETWORKS

TRAINED = [name for name, method in METHODS.items() if method.trained]
SMALL = {name: settings | {"batch": 8} for name, settings in NETWORKS.items()}


def task_of(method: str, budget: str | None, **policy) -> PolicyTask:
    """The task of one method as `demobench run tape --policies METHOD --budget BUDGET` makes it."""
    chunks = {"chunks": [2]} if METHODS[method].chunk == "set" else {}
    settings = {"settings": SMALL[method]} if method in SMALL else {}
    raw = {
        "benchmark": {"seeds": 1, "folds": 1, "threads": 1, "device": "cpu"},
        "datasets": {"tape": {"source": "data/tape"}},
        "policies": {"asked": {"method": method, **chunks, **settings, **policy}},
    }
    choices = Choices(policies=("asked",), budget=budget)
    target = resolve_target("tape", parse_config(raw, "test"), Path("/somewhere"), choices, {})
    (variant,) = (v for v in target.selected if v.family == "asked")
    demos = random_walks((12,) * 5)
    return PolicyTask(
        demos, semantics(demos), split_of(target.experiment, demos), STATE_ONLY, variant, target.experiment
    )


@pytest.mark.parametrize("budget", BUDGETS)
@pytest.mark.parametrize("method", TRAINED)
def test_a_budget_s_name_is_its_steps_for_every_method(method, budget):
    """The camera's and the ones that train nothing among them; a budget of the policy's own gives way to it."""
    assert task_of(method, budget).training["steps"] == BUDGETS[budget]
    if "steps" in METHODS[method].takes:
        for own in ({"steps": 7}, {"cpu_seconds": 3.0}):
            assert task_of(method, None, **own).training["steps"] == own.get("steps")
            asked = task_of(method, budget, **own).training
            assert (asked["steps"], asked["cpu_seconds"]) == (BUDGETS[budget], None)


def test_without_a_name_it_is_the_standard():
    assert task_of("mlp", None).training["steps"] == BUDGETS["standard"] == 3000


@pytest.mark.slow
@pytest.mark.parametrize("method", [name for name in TRAINED if not METHODS[name].camera])
def test_quick_trains_every_method_for_its_steps(method):
    """Small networks, a small data set, and the whole of the budget. `lwr` remembers: it has no steps."""
    task = task_of(method, "quick")
    trained = train_fold(task, task.split.folds[0])
    assert trained.steps == (BUDGETS["quick"] if METHODS[method].takes & {"steps"} or method == "notebook_pusht" else 0)
