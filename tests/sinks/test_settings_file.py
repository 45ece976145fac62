"""The settings that a page shows give its experiment again, and a command alone is given only where it is enough."""

import tomllib
from pathlib import Path

import pytest

from pipeline.config import Config, parse_config
from pipeline.experiment import Choices, from_config, resolve_target
from pipeline.sinks.settings_file import command_is_enough, settings_file

REPOSITORY = Path(__file__).resolve().parents[2]
ODD = {
    "benchmark": {"seeds": 3, "steps": 77, "rollout_seeds": 2, "rollouts_from": 1000, "folds": 4, "split_seed": 9},
    "datasets": {
        "tape": {
            "source": "/data/a \"tape\"\\\t\u2026", "kind": {"gripper.pos": "other"},
            "units": {"shoulder_pan.pos": "deg", "ü": "%"},
            "observations": {"pose": ["observation.state", "x"], "one": {"features": ["observation.state"], "history": 1}},
            "champion": "flow_k08/pose", "floor_horizons": [0, 5], "exclude": [3, 1],
            "safety": {"low": {"deg": -90.5}, "stop_after": 4},
        },
    },
    "policies": {
        "flow": {"method": "flow", "chunks": [8, 16], "cpu_seconds": 60.0, "observations": ["pose"], "execute": 4},
        "quiet": {"method": "mlp", "chunks": [4], "augment": {"noise": {"deg": 0.5}}, "only_when_named": True, "carry_on": True},
    },
}  # fmt: skip


def read_again(experiment):
    return from_config(parse_config(tomllib.loads(settings_file(experiment)), "the page"), experiment.name, Path("/"))


@pytest.mark.parametrize("name", ["pusht_sim", "so101_sim"])
def test_the_settings_of_the_projects_own_file_are_read_again_as_they_were(name):
    config = parse_config(tomllib.loads((REPOSITORY / "demobench.toml").read_text()), "demobench.toml")
    experiment = from_config(config, name, REPOSITORY)
    assert read_again(experiment) == experiment


def test_any_settings_are_read_again_as_they_were():
    experiment = from_config(parse_config(ODD, "odd"), "tape", Path("/"))
    assert read_again(experiment) == experiment


def test_a_command_line_that_changed_something_is_in_the_settings():
    choices = Choices(seeds=2, steps=600, chunks=(2,), policies=("mlp",))
    changed = resolve_target("pusht_sim", Config(), Path("/"), choices, {}).experiment
    assert read_again(changed) == changed
    odd = resolve_target("pusht_sim", Config(), Path("/"), Choices(steps=601), {}).experiment
    again = read_again(odd)
    assert (again.steps, again.budget) == (601, None)
    assert again.model_copy(update={"dataset": odd.dataset}) == odd


def test_the_command_alone_is_given_only_where_it_gives_the_same():
    for choices in (Choices(), Choices(steps=50, seeds=2, folds=3, protocol="notebook")):
        assert command_is_enough(resolve_target("pusht_sim", Config(), Path("/"), choices, {}).experiment)
    folder = resolve_target(str(REPOSITORY), Config(), Path("/"), Choices(seeds=1), {}).experiment
    assert command_is_enough(folder)
    assert not command_is_enough(from_config(parse_config(ODD, "odd"), "tape", Path("/")))
    more_chunks = resolve_target("pusht_sim", Config(), Path("/"), Choices(chunks=(2,)), {}).experiment
    assert not command_is_enough(more_chunks)
