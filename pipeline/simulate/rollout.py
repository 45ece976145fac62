"""Rolling a policy out: many environments side by side, the policy asked once for all of them.

What belongs here: the loop between policy and simulator, for any simulator. What does not: physics, success intervals.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from pipeline.errors import PolicyError
from pipeline.execution import STILL, settled
from pipeline.predict import average_answers
from pipeline.safety import NOT_FINITE, RUNS, Guard, Limits
from pipeline.simulate import Environments, Simulator
from pipeline.types import AS_USUAL, STATE, Execution, Observations, ObservationSet, Rollouts, Scenes

BATCH = 50
"""Environments that a policy is asked for together. Fixed: the size of a batch changes the last bits of a matrix
product, and contacts turn them into different episodes."""
SCENES = 8
"""Of how many start states, the first ones, everything that is seen is usually kept: enough for a video, and small."""
APART = 4
"""Frames between two answers that are kept, at least: a policy that is asked at every frame says much the same again."""


def rollout(
    policy,
    simulator: Simulator,
    observation_set: ObservationSet,
    start_states: Sequence[int],
    *,
    name: str,
    seed: int = 0,
    history: int,
    execution: Execution = AS_USUAL,
    circular: np.ndarray | None = None,
    limits: Limits | None = None,
    max_steps: int | None = None,
    batch: int = BATCH,
    scenes: int = 0,
    on_frame: Callable[[int, int], None] | None = None,
) -> Rollouts:
    """Ask a policy, carry out what `execution` says of its chunk, ask again (`pipeline.execution` says when what acts).

    An environment that has succeeded stops; the others go on until `max_steps` (default: the simulator's own limit).
    Its row stays in what the policy is asked, so every call has `batch` rows. The safety layer stands between the
    policy and every robot; where it stops one, the episode is over. History before the first frame repeats the first
    frame, as in the windows a policy is trained on.

    Args:
        policy: `predict(Observations) -> [S, B, K, A]`; the first seed acts.
        start_states: numbers of start states (`Simulator.start`).
        name, seed: of the policy, for the record.
        history: frames the policy is shown.
        circular: [A] bool, action columns that an ensemble averages as directions.
        limits: of the safety layer; the simulator's own if none are given.
        scenes: of how many start states, the first ones, what there is to see is kept.
        on_frame: called with (frames done, frames at most), over all batches.

    Raises:
        PolicyError: an answer has the wrong shape, or the first one of every episode is not finite.
        ConfigError: chunks as long as the policy's cannot be carried out like that, or limits cannot be kept from the start.
    """
    limit = simulator.max_steps if max_steps is None else max_steps
    numbers = list(start_states)
    parts, looked = [], []
    total = limit * -(-len(numbers) // batch)
    for first in range(0, len(numbers), batch):
        block = numbers[first : first + batch]
        padded = block + [block[-1]] * (batch - len(block))
        kept = min(max(scenes - first, 0), len(block))
        episode = _Episode(simulator, observation_set, padded, history, name, limits or simulator.limits(), kept)
        episode.running[len(block) :] = False
        for frame in episode.run(policy, execution, circular, limit):
            if on_frame:
                on_frame(len(parts) * limit + frame, total)
        parts.append({key: value[: len(block)] for key, value in episode.results().items()})
        looked += [episode.scenes()] if kept else []
        stage_names, how = episode.stage_names, episode.execution
    results = _joined(parts)
    _require_answers(results, name, seed)
    return Rollouts(
        simulator=simulator.name,
        simulator_version=simulator.version(),
        policy=name,
        observations=observation_set.name,
        start_states=np.asarray(numbers, dtype=np.int64),
        stage_names=stage_names,
        execution=how,
        seed=seed,
        scenes=_joined_scenes(looked) if looked else None,
        **results,
    )


class _Episode:
    """`batch` environments from their start states to their ends, and what is remembered of them."""

    def __init__(
        self,
        simulator: Simulator,
        observation_set: ObservationSet,
        numbers: list[int],
        history: int,
        name: str,
        limits: Limits,
        scenes: int,
    ):
        self._features, self._name = observation_set.features, name
        self._environments: Environments = simulator.start(numbers)
        rows, columns = len(numbers), len(limits.names)
        self._standing = self._stood = self._environments.standing()
        self._guard = Guard(limits, self._standing)
        self._seen = [self._environments.observe()] * history
        self._previous = np.full((rows, columns), np.nan, dtype=np.float32)
        self.running = np.ones(rows, dtype=bool)
        self.frame = 0
        self._success = np.zeros(rows, dtype=bool)
        self._best_reward, self._best_coverage = np.zeros(rows), np.zeros(rows)
        self._stages: dict[str, np.ndarray] = {}
        self._steps = np.zeros(rows, dtype=np.int64)
        self._path = [self._where(self.running)]
        self._scenes_kept = scenes
        self._scenes = [self._look(self.running)]
        self._kept: list[tuple[int, np.ndarray]] = []
        self._answers: deque[tuple[int, np.ndarray]] = deque()
        self.execution = AS_USUAL

    def run(self, policy, execution: Execution, circular: np.ndarray | None, limit: int) -> Iterator[int]:
        """To the end of all environments; gives the frame before every question but the first, and the last one."""
        while self.running.any() and self.frame < limit:
            answer = self.ask(policy)
            self.execution = settled(execution, answer.shape[1])
            self._answers.append((self.frame, self.carried_on(answer) if execution.carry_on else answer))
            for _ in range(min(self.execution.execute, limit - self.frame)):
                if self.running.any():
                    self.act(self.due(circular))
            yield self.frame

    def due(self, circular: np.ndarray | None) -> np.ndarray:
        """[R, A] the actions of this frame, from the answers that are there."""
        while self._answers and self._answers[0][0] + self._answers[0][1].shape[1] <= self.frame:
            self._answers.popleft()
        there = [answer for asked, answer in self._said_of_now() if asked + self.execution.delay <= self.frame]
        if not there:
            return self._standing
        return average_answers(np.stack(there), circular) if self.execution.ensemble else there[-1]

    def _said_of_now(self) -> list[tuple[int, np.ndarray]]:
        """When each answer was asked for, oldest first, and what it says of this frame [R, A]."""
        return [(asked, chunk[:, self.frame - asked]) for asked, chunk in self._answers]

    def carried_on(self, answer: np.ndarray) -> np.ndarray:
        """[R, K, A] the new answer, or what is left of the last one where the robot still stands where it was asked then."""
        stood, self._stood = self._stood, self._environments.standing()
        if not self._answers:
            return answer
        still = (np.abs(self._stood - stood) <= STILL * self._guard.limits.ranges).all(axis=1)
        asked, before = self._answers[-1]
        gone = np.minimum(np.arange(answer.shape[1]) + self.frame - asked, answer.shape[1] - 1)
        return np.where(still[:, None, None], before[:, gone], answer)

    def ask(self, policy) -> np.ndarray:
        """[R, K, A] the policy's chunk for every environment, finished ones included."""
        shown = [np.concatenate([seen[key] for key in self._features], axis=1) for seen in self._seen]
        empty = np.zeros((len(self.running), 0), dtype=np.float32)
        state = np.stack([seen.get(STATE, empty) for seen in self._seen], axis=1)
        answer = np.asarray(policy.predict(Observations(np.stack(shown, axis=1), state, self._previous.copy())))
        rows, columns = self._previous.shape
        if answer.ndim != 4 or answer.shape[1] != rows or answer.shape[3] != columns or 0 in answer.shape:
            raise PolicyError(
                f"Policy '{self._name}' answered with shape {answer.shape} in a roll-out; expected "
                f"[seeds, {rows}, chunk, {columns}]."
            )
        self._keep(answer[0])
        return answer[0]

    def _keep(self, answers: np.ndarray) -> None:
        """Remember what the first environments were told, [R, K, A], unless that was done a moment ago."""
        if not self._kept or self.frame - self._kept[-1][0] >= APART:
            said = answers[: self._scenes_kept].astype(np.float32)
            self._kept.append((self.frame, np.where(self.running[: len(said), None, None], said, np.nan)))

    def act(self, actions: np.ndarray) -> None:
        """One frame in every environment that still runs and is not stopped now; actions [R, A]."""
        safe = self._guard(actions, self.running)
        ran = self.running & (self._guard.stopped == RUNS)
        outcome = self._environments.step(safe, ran)
        self.frame += 1
        self._previous[ran] = safe[ran]
        self._seen = [*self._seen[1:], self._environments.observe()]
        self._best_reward = np.where(ran, np.maximum(self._best_reward, outcome.reward), self._best_reward)
        self._best_coverage = np.where(ran, np.maximum(self._best_coverage, outcome.coverage), self._best_coverage)
        for stage, reached in outcome.stages.items():
            self._stages[stage] = self._stages.get(stage, False) | (ran & reached)
        self._steps += ran
        self._success |= ran & outcome.success
        self.running = ran & ~outcome.success
        self._path.append(self._where(ran))
        self._scenes.append(self._look(ran))

    @property
    def stage_names(self) -> tuple[str, ...]:
        return tuple(self._stages)

    def results(self) -> dict[str, np.ndarray]:
        stages = {"stages": np.stack(list(self._stages.values()), axis=1)} if self._stages else {}
        return stages | {
            "success": self._success,
            "best_reward": self._best_reward,
            "best_coverage": self._best_coverage,
            "steps": self._steps,
            "interventions": self._guard.interventions,
            "corrections": self._guard.corrections,
            "stopped": self._guard.stopped,
            "paths": np.stack(self._path, axis=1),
        }

    def scenes(self) -> Scenes:
        """What the first environments showed, and what the policy said it would do there."""
        shown = {key: np.stack([scene[key] for scene in self._scenes], axis=1) for key in self._scenes[0]}
        asked = np.array([frame for frame, _ in self._kept], dtype=np.int64)
        return Scenes(shown, asked, np.stack([said for _, said in self._kept], axis=1))

    def _look(self, moved: np.ndarray) -> dict[str, np.ndarray]:
        """Feature key → [S, D] what is seen of the environments whose scenes are kept, NaN where it stood still."""
        first = moved[: self._scenes_kept, None]
        seen = {key: values[: len(first)] for key, values in self._seen[-1].items()}
        return {key: np.where(first, values, np.nan).astype(np.float32) for key, values in seen.items()}

    def _where(self, moved: np.ndarray) -> np.ndarray:
        """[R, 2] where the end effector is, NaN where it stood still; [R, 0] where there is nothing to draw."""
        place = self._environments.effector()
        if place is None:
            return np.zeros((len(moved), 0), dtype=np.float32)
        return np.where(moved[:, None], place, np.nan).astype(np.float32)


def _require_answers(results: dict[str, np.ndarray | None], name: str, seed: int) -> None:
    """A policy that cannot be asked at all has no success rate."""
    if ((results["stopped"] == NOT_FINITE) & (results["steps"] == 0)).all():
        raise PolicyError(
            f"Policy '{name}' answered with NaN or infinite actions in a roll-out (seed {seed}), at the first step of every "
            "episode. "
            "Its training has probably diverged: look at its loss."
        )


def _joined(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray | None]:
    """The batches one after another; paths are padded with NaN to the longest, and None where there is nothing in them."""
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0] if key != "paths"}
    paths = _end_to_end([part["paths"] for part in parts])
    return joined | {"paths": paths if paths.shape[2] else None}


def _joined_scenes(parts: list[Scenes]) -> Scenes:
    """Those of the batches one after another; all were asked at the same frames, as far as they went."""
    keys = parts[0].shown
    shown = {key: _end_to_end([part.shown[key] for part in parts]) for key in keys}
    asked = max((part.asked for part in parts), key=len)
    return Scenes(shown, asked, _end_to_end([part.chunks for part in parts]))


def _end_to_end(blocks: list[np.ndarray]) -> np.ndarray:
    """Blocks [r, l, …] one after another, each padded with NaN to the longest."""
    longest = max(block.shape[1] for block in blocks)
    rest = [(0, 0)] * (blocks[0].ndim - 2)
    return np.concatenate(
        [np.pad(b, ((0, 0), (0, longest - b.shape[1]), *rest), constant_values=np.nan) for b in blocks]
    )
