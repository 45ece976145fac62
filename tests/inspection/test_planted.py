"""Every fault of `speed.planted` is found where it was planted, in a made-up arm and in copies of real recordings."""

import numpy as np
import pytest

from pipeline.inspection.finding import CHECKS
from pipeline.inspection.look import inspect
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import read_dataset
from pipeline.types import Demonstrations
from speed.planted import FAULTS, WHOLE, Fault, made_arm


@pytest.fixture(scope="module")
def arm() -> Demonstrations:
    return made_arm(12, 1)


@pytest.fixture(scope="module")
def tape(shared_data) -> Demonstrations:
    return read_dataset(shared_data / "so101_pick_place_tape", name="tape")


def findings(demos: Demonstrations):
    return inspect(demos, resolve_semantics(demos)).findings


def assert_found(fault: Fault, demos: Demonstrations, position: int) -> None:
    changed, numbers = fault.plant(demos, position, np.random.default_rng(0))
    found = findings(changed)
    assert any(f.check == fault.check and f.episode in numbers for f in found), [f.words for f in found]


@pytest.mark.parametrize("seed", range(3))
def test_a_clean_arm_is_clean(seed):
    assert findings(made_arm(12, seed)) == ()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_of_one_episode_is_found_in_it(arm, fault):
    assert_found(fault, arm, 4)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_it_is_found_in_a_copy_of_a_real_recording(tape, fault):
    assert_found(fault, tape, 17)


@pytest.mark.parametrize("name", WHOLE)
def test_a_fault_of_all_episodes_is_found(arm, name):
    check, change = WHOLE[name]
    assert check in {finding.check for finding in findings(change(arm))}


def test_planting_leaves_the_original_alone(arm):
    before = {key: values.copy() for key, values in arm.columns.items()}
    for fault in FAULTS:
        fault.plant(arm, 2, np.random.default_rng(0))
    assert all(np.array_equal(arm.columns[key], values) for key, values in before.items())


def test_every_fault_belongs_to_a_check():
    assert {fault.check for fault in FAULTS} | {check for check, _ in WHOLE.values()} <= set(CHECKS)


def test_cr5_banana_has_a_dead_joint_and_an_uneven_clock(shared_data):
    demos = read_dataset(shared_data / "cr5_banana", name="cr5")
    found = findings(demos)
    assert {f.column for f in found if f.check == "dead"} == {"action/joint_5_vel", "observation.state/joint_5"}
    clock = [f for f in found if f.check == "clock"]
    assert [f.episode for f in clock] == [None]
    assert clock[0].words.startswith("Uneven clock: a tick lasts 0.060 to 0.274 s")
    assert {(f.check, f.episode) for f in found if f.episode is not None} == {("idle", 7), ("jump", 11)}


@pytest.mark.parametrize("name", ["pusht", "pusht_image"])
def test_nothing_looks_wrong_with_pusht(shared_data, name):
    demos = read_dataset(shared_data / name, name=name)
    assert inspect(demos, resolve_semantics(demos), shared_data / name).findings == ()
