"""The loop between policy and simulator, on a made-up world with known answers and on PushT."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from pipeline.errors import ConfigError, PolicyError
from pipeline.predict import average_answers, temporal_ensemble
from pipeline.safety import NOT_FINITE, REPEATED, RUNS, Limits
from pipeline.simulate import Outcome
from pipeline.simulate.pusht import BLOCK, PushT, environment_class
from pipeline.simulate.rollout import BATCH, rollout
from pipeline.types import STATE, Execution, Observations, ObservationSet

SET = ObservationSet("state", (STATE,))


class Line:
    """A point on a line that starts at its number / 100 and moves to where it is told; it succeeds from 1 on."""

    name, max_steps = "line", 20

    def __init__(self, draws: bool = True):
        self.draws = draws

    def version(self) -> str:
        return "line 1"

    def limits(self) -> Limits:
        return Limits(("x",), np.array([-1.0]), np.array([2.0]), np.array([np.inf]))

    def fits(self, demos, observation_set):
        return None

    def start(self, numbers):
        return _Points(np.asarray(numbers, dtype=np.float64)[:, None] / 100, self.draws)


class _Points:
    def __init__(self, at: np.ndarray, draws: bool):
        self.at, self.draws = at.copy(), draws

    def observe(self):
        return {STATE: self.at.astype(np.float32)}

    def step(self, actions, running):
        self.at[running] = actions[running]
        done = np.where(running, self.at[:, 0], 0.0)
        return Outcome(np.clip(done, 0, 1), done, done >= 1)

    def standing(self):
        return self.at.astype(np.float32)

    def effector(self):
        return np.repeat(self.at, 2, axis=1) if self.draws else None


@dataclass
class Creeper:
    """Moves `step` further in each of `chunk` actions, and remembers how it was asked."""

    step: float = 0.1
    chunk: int = 16
    asked: list[Observations] = field(default_factory=list)

    def predict(self, observations: Observations) -> np.ndarray:
        self.asked.append(observations)
        ahead = self.step * np.arange(1, self.chunk + 1, dtype=np.float32)
        first_seed = observations.values[:, -1, None, :1] + ahead[:, None]
        return np.stack([first_seed, first_seed - 100])


def test_an_episode_ends_at_success_and_no_later_than_the_limit():
    results = rollout(Creeper(), Line(), SET, [0, 50, -150], name="creeper", history=2)
    assert results.steps.tolist() == [10, 5, 20]
    assert results.success.tolist() == [True, True, False]
    assert results.best_reward == pytest.approx([1, 1, 0.5])
    assert results.start_states.tolist() == [0, 50, -150]
    assert (results.policy, results.observations, results.simulator_version) == ("creeper", "state", "line 1")


def test_paths_hold_every_place_and_nothing_after_the_end():
    results = rollout(Creeper(), Line(), SET, [0, 50], name="creeper", history=1)
    assert results.paths.shape == (2, 11, 2)
    np.testing.assert_allclose(results.paths[0, :, 0], np.arange(11) / 10, atol=1e-6)
    np.testing.assert_allclose(results.paths[1, :6, 1], np.arange(5, 11) / 10, atol=1e-6)
    assert np.isnan(results.paths[1, 6:]).all()
    assert rollout(Creeper(), Line(draws=False), SET, [0], name="creeper", history=1).paths is None


def test_scenes_hold_what_was_seen_and_said_of_the_first_start_states():
    results = rollout(Creeper(), Line(), SET, [0, 50, 99, 7], name="creeper", history=1, scenes=3, batch=2)
    scenes = results.scenes
    assert scenes.shown[STATE].shape == (3, 11, 1)
    np.testing.assert_allclose(scenes.shown[STATE][0, :, 0], np.arange(11) / 10, atol=1e-6)
    np.testing.assert_allclose(scenes.shown[STATE][1, :6, 0], np.arange(5, 11) / 10, atol=1e-6)
    assert np.isfinite(scenes.shown[STATE]).sum(axis=(1, 2)).tolist() == (results.steps[:3] + 1).tolist()
    assert scenes.asked.tolist() == [0, 8]
    np.testing.assert_allclose(scenes.chunks[0, 1, :, 0], 0.8 + 0.1 * np.arange(1, 17), atol=1e-6)
    assert np.isnan(scenes.chunks[1:, 1]).all(), "over before it was asked again"
    assert rollout(Creeper(), Line(), SET, [0], name="creeper", history=1).scenes is None


def test_scenes_keep_few_answers_of_a_policy_that_is_asked_at_every_frame():
    results = rollout(
        Creeper(step=0.001), Line(), SET, [0], name="creeper", history=1, execution=Execution(1), scenes=1
    )
    assert results.scenes.asked.tolist() == [0, 4, 8, 12, 16]


def test_history_begins_with_the_first_frame_repeated():
    policy = Creeper(step=0.01)
    rollout(policy, Line(), SET, [7], name="creeper", history=3, execution=Execution(1), max_steps=4)
    seen = [asked.values[0, :, 0] for asked in policy.asked]
    expected = [[0.07, 0.07, 0.07], [0.07, 0.07, 0.08], [0.07, 0.08, 0.09], [0.08, 0.09, 0.10]]
    np.testing.assert_allclose(seen, expected, atol=1e-6)
    assert np.isnan(policy.asked[0].previous_action).all()
    assert policy.asked[2].previous_action[0, 0] == pytest.approx(0.09)
    assert all(asked.anchors is None and asked.state.shape == (BATCH, 3, 1) for asked in policy.asked)


@pytest.mark.parametrize(
    ("chunk", "execute", "asked"), [(16, None, 3), (4, None, 5), (1, None, 20), (16, 2, 10), (16, 16, 2)]
)
def test_a_chunk_is_carried_out_as_far_as_asked(chunk, execute, asked):
    policy = Creeper(step=0.001, chunk=chunk)
    results = rollout(policy, Line(), SET, [0], name="creeper", history=1, execution=Execution(execute))
    assert len(policy.asked) == asked
    assert results.steps.tolist() == [20]
    assert results.execution == Execution(execute or min(8, chunk))


class Restless:
    """Answers anything, different for every place, and always the same there; remembers what it said."""

    def __init__(self, chunk: int):
        self.ahead, self.said = np.arange(chunk, dtype=np.float32), []

    def predict(self, observations: Observations) -> np.ndarray:
        at = observations.values[:, -1, :1]
        answer = 0.9 * np.sin(97 * at + 3 * self.ahead)[None, :, :, None]
        self.said.append(answer[0])
        return answer


def by_hand(execution: Execution, chunk: int, at: float, frames: int) -> list[float]:
    """The places of one environment, from a loop that keeps every answer and looks through all of them in every frame."""
    policy, answers, path = Restless(chunk), {}, [np.float32(at)]
    for frame in range(frames):
        if execution.ensemble or frame % execution.execute == 0:
            shown = np.array([[[path[-1]]]], dtype=np.float32)
            answers[frame] = policy.predict(Observations(shown, shown, np.zeros((1, 1))))[0, 0, :, 0]
        there = [asked for asked in answers if asked + execution.delay <= frame < asked + chunk]
        if not there:
            action = path[0]
        elif execution.ensemble:
            weights = [np.exp(-0.01 * older) for older in range(len(there))]
            said = [float(answers[asked][frame - asked]) for asked in there]
            action = sum(w * a for w, a in zip(weights, said, strict=True)) / sum(weights)
        else:
            action = answers[there[-1]][frame - there[-1]]
        path.append(np.float32(action))
    return path


@pytest.mark.parametrize(
    ("chunk", "execution"),
    [
        (8, Execution(3)), (8, Execution(8)), (1, Execution(1)), (8, Execution(4, delay=2)), (8, Execution(4, delay=4)),
        (9, Execution(5, delay=1)), (6, Execution(1, ensemble=True)), (6, Execution(1, ensemble=True, delay=1)),
    ],
    ids=str,
)  # fmt: skip
def test_every_way_of_carrying_chunks_out_equals_a_slow_loop(chunk, execution):
    starts = [-90, -3, 0, 42]
    results = rollout(Restless(chunk), Line(), SET, starts, name="r", history=1, execution=execution, batch=4)
    expected = [by_hand(execution, chunk, start / 100, 20) for start in starts]
    np.testing.assert_allclose(results.paths[:, :, 0], expected, atol=1e-6)
    assert len(np.unique(results.paths[:, :, 0])) > 30
    assert results.execution == execution


def test_an_ensemble_is_the_one_that_is_measured_offline():
    policy = Restless(5)
    results = rollout(policy, Line(), SET, [7], name="r", history=1, execution=Execution(ensemble=True), batch=1)
    said = np.stack(policy.said, axis=1)
    offline = temporal_ensemble(said, np.arange(20), np.array([0, 20]))
    np.testing.assert_allclose(results.paths[0, 1:, 0], offline[0, :, 0], atol=1e-6)


def test_angles_are_averaged_as_directions():
    answers = np.array([[[3.1]], [[-3.1]]])
    assert abs(average_answers(answers, np.array([True]))[0, 0]) > 3.1
    assert abs(average_answers(answers)[0, 0]) < 0.1
    offline = temporal_ensemble(
        np.array([[[[0.0], [3.1]], [[-3.1], [0.0]]]]), np.arange(2), np.array([0, 2]), circular=np.array([True])
    )
    assert average_answers(answers, np.array([True]))[0, 0] == pytest.approx(offline[0, 1, 0])


def test_the_robot_stands_still_until_the_first_answer_is_there():
    results = rollout(Creeper(), Line(), SET, [30], name="c", history=1, execution=Execution(8, delay=3), batch=1)
    np.testing.assert_allclose(results.paths[0, :6, 0], [0.3, 0.3, 0.3, 0.3, 0.7, 0.8], atol=1e-6)


@dataclass
class Waiter:
    """Waits for `wait` frames where it is, and goes on then: asked again before that, it never does."""

    wait: int = 6

    def predict(self, observations: Observations) -> np.ndarray:
        ahead = 0.1 * np.maximum(np.arange(10, dtype=np.float32) + 1 - self.wait, 0)
        return (observations.values[:, -1, None, :1] + ahead[:, None])[None]


def test_a_pause_ends_only_where_the_answer_goes_on():
    for carry_on in (False, True):
        how = Execution(4, carry_on=carry_on)
        results = rollout(Waiter(), Line(), SET, [0, 95, -90], name="w", history=1, execution=how, batch=3)
        if not carry_on:
            np.testing.assert_allclose(results.paths[..., 0], np.tile([[0], [0.95], [-0.9]], 21), atol=1e-6)
        else:
            # Asked at 0; at 4 it has not moved, so actions 4 to 7 of that answer act; then it has moved and is asked anew.
            first = np.array([0, 0, 0, 0, 0, 0, 0, 0.1, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.3, 0.4])
            np.testing.assert_allclose(results.paths[0, :17, 0], first, atol=1e-6)
            np.testing.assert_allclose(results.paths[2, :17, 0], first - 0.9, atol=1e-6)
            assert results.steps.tolist() == [20, 7, 20]
        assert results.execution == how


def test_an_answer_that_is_over_ends_in_its_last_action():
    """Behind an obstacle nothing moves: the answer runs out and its last action stays, the policy is not asked in vain."""

    class Wall(_Points):
        def step(self, actions, running):
            return super().step(np.minimum(actions, 0.5), running)

    class Walled(Line):
        def start(self, numbers):
            return Wall(np.asarray(numbers, dtype=np.float64)[:, None] / 100, True)

    results = rollout(
        Creeper(step=0.2, chunk=6),
        Walled(),
        SET,
        [0],
        name="c",
        history=1,
        execution=Execution(2, carry_on=True),
        batch=1,
    )
    np.testing.assert_allclose(results.paths[0, :5, 0], [0, 0.2, 0.4, 0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(results.paths[0, 5:, 0], 0.5, atol=1e-6)


def test_a_chunk_that_cannot_be_carried_out_like_that_is_refused():
    with pytest.raises(ConfigError, match="execute = 9 needs a chunk of at least 9 actions, and this one has 4"):
        rollout(Creeper(chunk=4), Line(), SET, [0], name="c", history=1, execution=Execution(9))


def test_every_question_has_the_same_number_of_rows():
    policy = Creeper(step=0.02)
    numbers = list(range(7))
    results = rollout(policy, Line(), SET, numbers, name="creeper", history=1, batch=3)
    assert {len(asked) for asked in policy.asked} == {3}
    whole = rollout(Creeper(step=0.02), Line(), SET, numbers, name="creeper", history=1)
    np.testing.assert_array_equal(results.best_coverage, whole.best_coverage)
    np.testing.assert_array_equal(results.paths, whole.paths)


def test_actions_are_clipped_to_the_action_space():
    results = rollout(Creeper(step=-5.0), Line(), SET, [0], name="creeper", history=1, max_steps=3)
    np.testing.assert_array_equal(results.paths[0, :, 0], [0, -1, -1, -1])


def test_the_safety_layer_counts_and_stops():
    """The first keeps its limits; the second breaks them in half of its chunks; the third is NaN from its second question on."""

    class Odd(Creeper):
        def predict(self, observations):
            chunk = super().predict(observations)
            chunk[0, 1, 4:] = 9.0
            chunk[0, 2] = np.nan if len(self.asked) > 1 else chunk[0, 2]
            return chunk

    limits = replace(Line().limits(), high=np.array([0.9]))
    results = rollout(Odd(step=0.001), Line(), SET, [0, 1, 2], name="o", history=1, limits=limits, batch=3)
    assert results.interventions.tolist() == [0, 8, 1]
    # Of a range of 1.9, in the frames that ask for 9. Once it is there it asks for 0.901: held at 0.9, and no intervention.
    np.testing.assert_allclose(results.corrections, [0, 8 * (9 - 0.9) / 1.9, 0])
    assert results.stopped.tolist() == [RUNS, RUNS, NOT_FINITE]
    assert results.steps.tolist() == [20, 20, 8]
    assert results.success.tolist() == [False] * 3
    stopping = replace(limits, stop_after=3)
    results = rollout(Odd(step=0.001), Line(), SET, [0, 1, 2], name="o", history=1, limits=stopping, batch=3)
    assert results.stopped.tolist() == [RUNS, REPEATED, NOT_FINITE]
    assert results.steps.tolist() == [20, 6, 8]


class Walk(Line):
    """A line with two stages: half-way, and there."""

    def start(self, numbers):
        points = super().start(numbers)
        step = points.step

        def staged(actions, running):
            outcome = step(actions, running)
            return replace(outcome, stages={"half": outcome.reward >= 0.5, "there": outcome.success})

        points.step = staged
        return points


def test_stages_are_those_that_were_ever_reached():
    """The last turns back once it was half-way."""

    class Wanderer(Creeper):
        def predict(self, observations):
            chunk = super().predict(observations)
            chunk[0, 3] = np.minimum(chunk[0, 3], 0.55) if len(self.asked) == 1 else -1
            return chunk

    results = rollout(Wanderer(step=0.02, chunk=8), Walk(), SET, [0, -50, 15, 49], name="w", history=1, batch=4)
    assert results.stage_names == ("half", "there")
    assert results.stages.tolist() == [[False, False], [False, False], [True, False], [True, False]]
    further = rollout(Creeper(), Walk(), SET, [0, 50, -150], name="creeper", history=2, batch=2)
    assert further.stages.tolist() == [[True, True], [True, True], [True, False]]
    assert further.stage_counts == [3, 2]
    plain = rollout(Creeper(), Line(), SET, [0], name="creeper", history=1)
    assert plain.stages is None
    assert plain.stage_counts == []


def test_progress_is_told():
    told = []
    policy, tell = Creeper(step=0.001), lambda *at: told.append(at)
    rollout(policy, Line(), SET, range(4), name="creeper", history=1, batch=2, on_frame=tell)
    assert told == [(8, 40), (16, 40), (20, 40), (28, 40), (36, 40), (40, 40)]


class Broken:
    def __init__(self, answer):
        self.answer = answer

    def predict(self, observations):
        return self.answer(len(observations))


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda rows: np.zeros((1, rows, 4, 3)), r"expected \[seeds, 50, chunk, 1\]"),
        (lambda rows: np.zeros((1, rows, 1)), r"answered with shape \(1, 50, 1\)"),
        (lambda rows: np.full((1, rows, 4, 1), np.nan), "NaN or infinite actions"),
    ],
)
def test_a_wrong_answer_is_an_error_that_names_the_policy(answer, message):
    with pytest.raises(PolicyError, match=f"Policy 'bad'.*{message}"):
        rollout(Broken(answer), Line(), SET, [0], name="bad", history=1)


class Pusher:
    """Aims for the block's middle, a little differently in every frame; knows nothing of goals."""

    def predict(self, observations: Observations) -> np.ndarray:
        finger, block = observations.values[:, -1, :2], observations.values[:, -1, 2:4]
        ahead = np.linspace(0.2, 1.4, 8, dtype=np.float32)[:, None]
        return (finger[:, None] + ahead * (block - finger)[:, None])[None]


def test_a_roll_out_of_one_equals_the_environment_stepped_by_hand():
    observation_set = ObservationSet("pose", (STATE, BLOCK))
    results = rollout(Pusher(), PushT(), observation_set, [3], name="pusher", history=1, max_steps=60, batch=1)
    environment = environment_class()(obs_type="state")
    state, _ = environment.reset(seed=3)
    path, best = [state[:2]], 0.0
    for frame in range(60):
        if frame % 8 == 0:
            shown = state.astype(np.float32)[None, None]
            chunk = Pusher().predict(Observations(shown, shown[..., :2], np.full((1, 2), np.nan)))[0, 0]
        state, reward, *_ = environment.step(np.clip(chunk[frame % 8], 0, 512))
        path.append(state[:2])
        best = max(best, reward)
    np.testing.assert_array_equal(results.paths[0], np.array(path, dtype=np.float32))
    assert results.best_reward[0] == pytest.approx(best, abs=1e-12)


def test_a_roll_out_is_the_same_every_time():
    observation_set = ObservationSet("pose", (STATE, BLOCK))
    first, second = (
        rollout(Pusher(), PushT(), observation_set, range(4), name="p", history=1, max_steps=40, batch=4) for _ in "ab"
    )
    np.testing.assert_array_equal(first.paths, second.paths)
    np.testing.assert_array_equal(first.best_coverage, second.best_coverage)
