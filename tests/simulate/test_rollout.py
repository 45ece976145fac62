"""The loop between policy and simulator, on a made-up world with known answers and on PushT."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from pipeline.errors import PolicyError
from pipeline.simulate import Outcome
from pipeline.simulate.pusht import BLOCK, PushT, environment_class
from pipeline.simulate.rollout import BATCH, rollout
from pipeline.types import STATE, Observations, ObservationSet

SET = ObservationSet("state", (STATE,))


class Line:
    """A point on a line that starts at its number / 100 and moves to where it is told; it succeeds from 1 on."""

    name, max_steps = "line", 20
    action_low, action_high = np.array([-1.0]), np.array([2.0])

    def __init__(self, draws: bool = True):
        self.draws = draws

    def version(self) -> str:
        return "line 1"

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


def test_history_begins_with_the_first_frame_repeated():
    policy = Creeper(step=0.01)
    rollout(policy, Line(), SET, [7], name="creeper", history=3, execute=1, max_steps=4)
    seen = [asked.values[0, :, 0] for asked in policy.asked]
    expected = [[0.07, 0.07, 0.07], [0.07, 0.07, 0.08], [0.07, 0.08, 0.09], [0.08, 0.09, 0.10]]
    np.testing.assert_allclose(seen, expected, atol=1e-6)
    assert np.isnan(policy.asked[0].previous_action).all()
    assert policy.asked[2].previous_action[0, 0] == pytest.approx(0.09)
    assert all(asked.anchors is None and asked.state.shape == (BATCH, 3, 1) for asked in policy.asked)


@pytest.mark.parametrize(("chunk", "execute", "asked"), [(16, 8, 3), (4, 8, 5), (1, 8, 20), (16, 2, 10), (16, 30, 2)])
def test_a_chunk_is_carried_out_as_far_as_asked(chunk, execute, asked):
    policy = Creeper(step=0.001, chunk=chunk)
    results = rollout(policy, Line(), SET, [0], name="creeper", history=1, execute=execute)
    assert len(policy.asked) == asked
    assert results.steps.tolist() == [20]


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
