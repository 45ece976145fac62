"""The scripted demonstrator of PushT: carrying pushes out with an unsteady hand, and what is recorded of it.

What belongs here: demonstrating, and the columns of its data set. What does not: choosing pushes (`pusht_planner`), the words
of the card (`pusht_card`), recording in general (`recording`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.lerobot_format.write import FeatureArrays
from pipeline.simulate.pusht import (
    BLOCK,
    COLUMNS,
    FPS,
    MAX_STEPS,
    SUCCESS_COVERAGE,
    TABLE_PX,
    Coverage,
    advance,
    environment_class,
    make_environment,
    pose_columns,
    reward_of,
    versions,
)
from pipeline.simulate.pusht_card import card
from pipeline.simulate.pusht_planner import MARGIN_PX, Planner, state_of
from pipeline.simulate.recording import Demonstrator, last_of, record
from pipeline.types import ACTION, STATE

TASK = "Push the T-shaped block onto its outline."
STRATEGIES = {0: -1, 1: +1}
"""The `strategy` column → which way around the block the demonstrator prefers to walk (+1: as the block's angle
grows)."""
HAND_WALK_PX, HAND_PUSH_PX = 8.0, 1.0
"""Standard deviation of the hand's unsteadiness, in each of x and y, on the way to a push and while pushing.
Demonstrations that never stray teach nothing about getting back."""
HAND_MEMORY = 0.8
"""How much of it is left after a frame."""
ACTION_STEP_PX = 0.25
"""Actions are whole multiples of this, as a pointing device reports them; it also keeps the file small."""


@dataclass(frozen=True)
class Demonstration:
    """One successful episode of n frames. The last frame shows the success; its action repeats the one before it.

    finger, action [n, 2] px · block [n, 3] px, px, rad · coverage [n] after the frame's action; float32
    """

    number: int
    strategy: int
    finger: np.ndarray
    block: np.ndarray
    action: np.ndarray
    coverage: np.ndarray


def demonstrate(number: int) -> Demonstration | None:
    """Attempt start state `number`; None where the block does not get home within 300 steps."""
    environment = make_environment(number)
    coverage_of = Coverage(environment)
    random = np.random.default_rng([number, 1])
    strategy = int(random.integers(2))
    planner, hand = Planner(STRATEGIES[strategy]), _Hand(random)
    poses, actions, coverage = [pose_columns([environment])], [], []
    while len(actions) < MAX_STEPS:
        push = planner.next_push(state_of(environment))
        if push is None:
            return None
        for k, target in enumerate(push.targets[: MAX_STEPS - len(actions)]):
            action = hand.move(target, HAND_WALK_PX if k < push.walk_frames - 1 else HAND_PUSH_PX)
            advance(environment, float(action[0]), float(action[1]))
            actions.append(action)
            coverage.append(coverage_of([environment])[0])
            poses.append(pose_columns([environment]))
            if coverage[-1] > SUCCESS_COVERAGE:
                return Demonstration(
                    number,
                    strategy,
                    np.concatenate([pose[STATE] for pose in poses]),
                    np.concatenate([pose[BLOCK] for pose in poses]),
                    np.stack([*actions, actions[-1]]),
                    np.array([*coverage, coverage[-1]], dtype=np.float32),
                )
    return None


class _Hand:
    """Aims where it is told to, give or take a drifting error (a first-order autoregression of unit variance)."""

    def __init__(self, random: np.random.Generator):
        self._random = random
        self._error = random.standard_normal(2)

    def move(self, target: tuple[float, float], unsteadiness_px: float) -> np.ndarray:
        """[2] float32, the action: what is recorded is what is carried out."""
        fresh = self._random.standard_normal(2)
        self._error = HAND_MEMORY * self._error + (1 - HAND_MEMORY**2) ** 0.5 * fresh
        aimed = np.asarray(target) + unsteadiness_px * self._error
        reported = np.round(aimed / ACTION_STEP_PX) * ACTION_STEP_PX
        return np.clip(reported, MARGIN_PX, TABLE_PX - MARGIN_PX).astype(np.float32)


def features_of(kept: list[Demonstration]) -> dict[str, FeatureArrays]:
    """Feature key → names, [N, D] values, dtype, as the writer takes them. All but `strategy` have LeRobot's usual
    names."""
    lengths = [len(demonstration.action) for demonstration in kept]
    coverage = np.concatenate([demonstration.coverage for demonstration in kept])
    return {
        STATE: (COLUMNS[STATE], np.concatenate([demonstration.finger for demonstration in kept]), "float32"),
        BLOCK: (COLUMNS[BLOCK], np.concatenate([demonstration.block for demonstration in kept]), "float32"),
        ACTION: (COLUMNS[STATE], np.concatenate([demonstration.action for demonstration in kept]), "float32"),
        "next.coverage": (None, coverage[:, None], "float32"),
        "next.reward": (None, reward_of(coverage)[:, None], "float32"),
        "next.success": (None, (coverage > SUCCESS_COVERAGE)[:, None], "bool"),
        "next.done": (None, last_of(lengths), "bool"),
        "strategy": (None, np.repeat([d.strategy for d in kept], lengths)[:, None], "int64"),
    }


def _versions() -> dict[str, str]:
    environment_class()
    return versions()


PUSHT = Demonstrator(demonstrate, features_of, card, _versions, FPS, TASK, "pusht_pusher")


def record_pusht(
    out: Path,
    *,
    episodes: int = 200,
    seed: int = 0,
    workers: int = 2,
    on_episode: Callable[[int, int], None] | None = None,
) -> None:
    """Record PushT demonstrations into a new folder (see `recording.record`)."""
    record(PUSHT, out, episodes=episodes, seed=seed, workers=workers, on_episode=on_episode)
