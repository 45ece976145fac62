"""The suite must fail where something is broken: every estimator is broken on purpose, and a goal is missed.

The sound one passes beside it. Estimators are arguments of the studies; only their inner parts are patched.
"""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest

from pipeline.statistics import floors
from pipeline.statistics.brackets import gap_to_floor, value_of_sensors
from pipeline.statistics.comparisons import compare_paired, judge
from pipeline.statistics.curve import answer
from pipeline.statistics.floors import measure_floors
from pipeline.statistics.intervals import estimate_mean
from pipeline.statistics.known_truth.goals import GOALS, Goal, Place, Result, limits_in_words
from pipeline.statistics.known_truth.shards import as_cell
from pipeline.statistics.known_truth.studies import STUDIES
from pipeline.statistics.pilot import fit_pilot, waves
from pipeline.statistics.success import wilson
from pipeline.types import ACTION, STATE, FloorEstimate


def outcome(goal: str, study: str, repeats: int, settings: dict, **estimators) -> str | None:
    """What one goal says of one study."""
    record = STUDIES[study](repeats=range(repeats), **settings, **estimators)
    cell = as_cell(study, settings, [record])
    (wanted,) = (each for each in GOALS if each.name == goal)
    return Result(wanted, tuple(wanted.measure([cell]))).outcome


# What is broken -------------------------------------------------------------------------------------------------------


def naive_gamma(demos, semantics, observations, split, *, history, horizons, same_episode=False):
    """Half the squared difference of the actions of nearest frames: no extrapolation, perhaps from the same episode."""
    state, action = (demos.columns[key].astype(float) for key in (STATE, ACTION))
    state = state / state.std(axis=0)
    episode = demos.episode_of_frame
    values = []
    for frame in np.arange(0, demos.frames, 23):
        distance = ((state - state[frame]) ** 2).sum(axis=1)
        distance[frame if same_episode else episode == episode[frame]] = np.inf
        values.append(0.5 * ((action[frame] - action[distance.argmin()]) ** 2).mean())
    value = float(np.sqrt(np.mean(values)))
    found = measure_floors(demos, semantics, observations, split, history=history, horizons=horizons)
    return [
        replace(each, value=value, upper=None, interval=(0.9 * value, 1.1 * value), below=None, refused=None)
        for each in found
    ]


def from_the_same_episode(*arguments, **options):
    return naive_gamma(*arguments, **options, same_episode=True)


def changed_floors(change):
    return lambda *arguments, **options: [change(each) for each in measure_floors(*arguments, **options)]


def with_a_pilot_that_peeks(*arguments, **options):
    """The regression has seen both actions whose difference it explains."""

    def fit_to_all(inputs, actions, episode, episodes):
        seen = waves(inputs)
        weights = np.linalg.lstsq(seen, actions, rcond=None)[0]
        pilot = fit_pilot(inputs, actions, episode, episodes)
        return replace(pilot, weights=np.broadcast_to(weights, pilot.weights.shape))

    with patch.object(floors, "fit_pilot", fit_to_all):
        return measure_floors(*arguments, **options)


def blind_to_jumps(*arguments, **options):
    with patch.object(floors, "JUMPY", np.inf), patch.object(floors, "SURE_OF_JUMP", np.inf):
        return measure_floors(*arguments, **options)


def halved(floor: FloorEstimate) -> FloorEstimate:
    if floor.value is None or floor.loss == "rmse":
        return floor
    return replace(floor, value=floor.value / 2, upper=floor.upper / 2, interval=tuple(x / 2 for x in floor.interval))


def over_frames(centre: float, interval: tuple[float, float], frames: int = 60) -> tuple[float, float]:
    """An interval as if the frames of an episode were independent."""
    return tuple(centre + (end - centre) / np.sqrt(frames) for end in interval)


def floor_over_frames(floor: FloorEstimate) -> FloorEstimate:
    return floor if floor.value is None else replace(floor, interval=over_frames(floor.value, floor.interval))


def never_refused(floor: FloorEstimate) -> FloorEstimate:
    """In place of a refusal what the nearest neighbours show."""
    return (
        floor
        if floor.value is not None
        else replace(floor, value=floor.below, interval=(0.9 * floor.below, floor.below))
    )


def always_refused(floor: FloorEstimate) -> FloorEstimate:
    return replace(floor, value=None, upper=None, interval=None)


def too_low(floor: FloorEstimate) -> FloorEstimate:
    return replace(floor, value=None, interval=None, below=0.9 * (floor.value or 0.0))


def gap_over_frames(scored, floor):
    found = gap_to_floor(scored, floor)
    return found if found.interval is None else replace(found, interval=over_frames(found.gap, found.interval))


def gap_apart(scored, floor):
    """As if a policy's error and the floor were measured on different episodes."""
    found = gap_to_floor(scored, floor)
    if found.interval is None:
        return found
    parts = [np.ptp(x) / 2 for x in (found.error_interval, floor.interval)]
    half = np.hypot(*parts)
    return replace(found, interval=(found.gap - half, found.gap + half))


def worth_over_frames(floors, sights, brackets):
    return [
        found | {"interval": found["interval"] and over_frames(found["value"], found["interval"])}
        for found in value_of_sensors(floors, sights, brackets)
    ]


def mean_over_frames(values, counts=None, fold=None):
    found = estimate_mean(values, counts, fold)
    return replace(found, interval=over_frames(found.value, found.interval))


def mean_without_seeds(values, counts=None, fold=None):
    return estimate_mean(values.mean(axis=0, keepdims=True), counts)


def compare_without_seeds(a, b, counts=None, fold=None):
    return compare_paired(a.mean(axis=0, keepdims=True), b.mean(axis=0, keepdims=True), counts)


def compare_with_half_p(a, b, counts=None, fold=None):
    found = compare_paired(a, b, counts, fold)
    return replace(found, p=found.p / 2)


def unpaired(a, b, counts=None, fold=None):
    """The difference as if the two had been scored on different episodes."""
    found = compare_paired(a, b, counts, fold)
    wide = 1.96 * np.sqrt((a.mean(axis=0).var() + b.mean(axis=0).var()) / a.shape[1])
    return replace(found, interval=(found.difference - wide, found.difference + wide))


def judge_without_holm(pairs):
    return [judge([pair])[0] for pair in pairs]


def answer_no_when_unsure(curve, metric):
    """What cannot be told counts as no help."""
    found = answer(curve, metric)
    return replace(found, word="no" if found.word == "cannot tell" else found.word)


PLANE = {"generator": "plane", "episodes": 50}
TIED = {"generator": "slow_hand", "episodes": 50}
GRIPPER = {"generator": "gripper", "episodes": 50}
FINE = {"generator": "fine_hand", "episodes": 100}
SLOW = {"generator": "slow_hand", "episodes": 100}
EXACT = {"generator": "exact", "episodes": 100}
DRAWN = {"shape": "gaussian", "episodes": 50, "seeds": 5, "folds": 1}
ONE_SEED = {"shape": "gaussian", "episodes": 20, "seeds": 1, "folds": 1}
FAMILY = {"shape": "gaussian", "episodes": 20, "seeds": 5}

BROKEN = [
    ("gamma, 100 episodes", "floors", 16, FINE, {"measure": naive_gamma}, "no extrapolation"),
    ("gamma, 100 episodes", "floors", 16, SLOW, {"measure": from_the_same_episode}, "neighbours are copies in time"),
    ("gamma, 50 episodes", "floors", 12, TIED, {"measure": with_a_pilot_that_peeks}, "a pilot that saw both actions"),
    ("gamma, 50 episodes", "floors", 12, GRIPPER, {"measure": blind_to_jumps}, "jumps are not looked for"),
    ("brackets", "floors", 16, PLANE, {"measure": changed_floors(halved)}, "pair distance halved"),
    (
        "floor intervals",
        "floors",
        30,
        PLANE,
        {"measure": changed_floors(floor_over_frames)},
        "floor interval over frames",
    ),
    (
        "must answer",
        "floors",
        20,
        {**PLANE, "episodes": 100},
        {"measure": changed_floors(always_refused)},
        "all refused",
    ),
    ("below x", "floors", 16, PLANE, {"measure": changed_floors(too_low)}, "an upper limit below the truth"),
    ("gaps", "floors", 30, PLANE, {"gap": gap_over_frames}, "gap over frames"),
    ("gap widths", "floors", 80, PLANE, {"gap": gap_apart}, "gap not paired"),
    (
        "sensors",
        "floors",
        30,
        {"generator": "two_ways_round", "episodes": 50},
        {"worth": worth_over_frames},
        "worth over frames",
    ),
    ("intervals", "means", 200, ONE_SEED, {"estimate": mean_over_frames}, "interval over frames"),
    ("intervals", "means", 800, DRAWN, {"estimate": mean_without_seeds}, "seeds left out of the variance"),
    ("intervals", "differences", 800, DRAWN, {"compare": compare_without_seeds}, "seeds left out of a difference"),
    ("intervals", "differences", 800, ONE_SEED, {"compare": unpaired}, "episodes not paired"),
    ("false verdicts", "differences", 1500, ONE_SEED, {"compare": compare_with_half_p}, "p halved"),
    ("false verdicts", "differences", 800, DRAWN, {"compare": compare_without_seeds}, "seeds left out of a verdict"),
    ("false verdicts", "family", 150, FAMILY, {"verdicts": judge_without_holm}, "Holm left out"),
    ("false answers", "curve", 40, {"rate": 0.5}, {"answer": answer_no_when_unsure}, "no where it cannot be told"),
    ("success rates", "success", 1, {"trials": 20}, {"intervals": {"clopper_pearson": wilson}}, "Wilson for exact"),
]


@pytest.mark.parametrize(
    ("goal", "study", "repeats", "settings", "broken", "what"), BROKEN, ids=[b[-1] for b in BROKEN]
)
def test_a_broken_estimator_misses_its_goal(goal, study, repeats, settings, broken, what):
    assert outcome(goal, study, repeats, settings, **broken) == "missed"


SOUND = sorted({(goal, study, repeats, tuple(settings.items())) for goal, study, repeats, settings, *_ in BROKEN})


@pytest.mark.parametrize(
    ("goal", "study", "repeats", "settings"), SOUND, ids=[f"{s[0]}: {s[1]}, {s[3][0][1]}" for s in SOUND]
)
def test_the_sound_one_does_not(goal, study, repeats, settings):
    assert outcome(goal, study, repeats, dict(settings)) != "missed"


def test_a_number_below_the_fewest_episodes_is_a_miss():
    few = {"generator": "plane", "episodes": 20}
    assert outcome("too few episodes", "floors", 4, few) == "met"
    assert outcome("too few episodes", "floors", 12, few, measure=naive_gamma) == "missed"


def test_a_demonstrator_without_noise_gets_an_upper_limit():
    assert outcome("must answer", "floors", 4, EXACT) == "met"
    assert outcome("below x", "floors", 16, EXACT) == "met"
    nothing = changed_floors(lambda floor: replace(floor, below=None))
    assert outcome("must answer", "floors", 12, EXACT, measure=nothing) == "missed"


@pytest.mark.slow
def test_the_gate_is_blind_or_jumpy_when_broken():
    """On the null that moves, with policies that are really trained."""
    settings = {"generator": "arm", "episodes": 50, "seeds": 3, "resampled": True}
    assert outcome("false alarms", "null", 60, settings) != "missed"
    assert outcome("power", "null", 20, settings) == "met"
    assert (
        outcome("false verdicts", "null", 60, settings, compare=compare_without_seeds, verdicts=judge_without_holm)
        == "missed"
    )
    never = lambda pairs: [SimpleNamespace(word="cannot tell") for _ in pairs]  # noqa: E731
    assert outcome("power", "null", 20, settings, verdicts=never) == "missed"


@pytest.mark.slow
def test_modes_found_everywhere_are_a_miss():
    one = {"generator": "skewed", "observations": "state", "episodes": 50}
    several = {"generator": "coin", "observations": "state", "episodes": 50}
    assert outcome("false modes", "modes", 4, one) != "missed"
    assert outcome("modes found", "modes", 3, several) == "met"
    always = lambda *_, **__: [SimpleNamespace(found=True, gain=1.0)]  # noqa: E731
    assert outcome("false modes", "modes", 6, one, evidence=always) == "missed"


# Judging ---------------------------------------------------------------------------------------------------------------


def place(value: float, error: float) -> Place:
    wide = (value - 2.5 * error, value + 2.5 * error)
    return Place("here", value, value - 2 * error, value + 2 * error, wide, 100)


def test_a_goal_is_missed_only_surely():
    goal = Goal("g", "w", 92, 97, "%", lambda cells: iter(()))
    assert goal.outcome(place(92, 5)) == "met"
    assert goal.outcome(place(91, 1)) == "unsure"
    assert goal.outcome(place(91, 0.1)) == "missed"
    assert goal.outcome(place(98, 0.1)) == "missed"
    result = Result(goal, (place(95, 1), place(91, 1), place(99, 0.1)))
    assert result.outcome == "missed"
    assert result.worst.value == 99
    assert Result(goal, ()).outcome is None
    assert Result(goal, ()).worst is None


def test_limits_in_words():
    words = {goal.name: limits_in_words(goal) for goal in GOALS}
    assert words["intervals"] == "92 … 97 %"
    assert words["power"] == "≥ 80 %"
    assert words["false alarms"] == "≤ 5 %"
    assert words["floor widths"] == "≤ 2 times"
