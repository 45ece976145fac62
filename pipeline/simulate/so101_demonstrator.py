"""The scripted demonstrator of the SO-101: the leader leads, the follower follows, and what is recorded of it.

What belongs here: demonstrating, and the columns of its data set. What does not: the leader's way (`so101_leader`), the words
of the card (`so101_card`), recording in general (`recording`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipeline.lerobot_format.write import FeatureArrays
from pipeline.simulate.recording import Demonstrator, last_of, record
from pipeline.simulate.so101 import POSE, POSE_NAMES, World, as_encoders_report
from pipeline.simulate.so101_arm import NAMES, InverseKinematics
from pipeline.simulate.so101_card import card
from pipeline.simulate.so101_leader import Hand, lead
from pipeline.simulate.so101_world import DRAWS_LEADER, FPS, arm_file, model, versions
from pipeline.types import ACTION, STATE

TASK = "Pick up the cube and place it on the target."


@dataclass(frozen=True)
class Demonstration:
    """One successful episode of n frames, at 30 Hz from the start state to the arm's return.

    state, action [n, 6] deg and % · pose [n, 7] · reward [n] and success [n] after the frame's action
    """

    number: int
    strategy: int
    state: np.ndarray
    pose: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    success: np.ndarray


def demonstrate(number: int, hand: Hand | None = None) -> Demonstration | None:
    """Attempt start state `number`; None where the cube does not stand on the target once the arm has returned."""
    random = np.random.default_rng([DRAWS_LEADER, number])
    strategy = int(random.integers(2))
    world = World(number)
    way = lead(world.start, strategy, hand or Hand(), random, _arm())
    if way is None:
        return None
    states, poses, stages = [], [], []
    actions = as_encoders_report(way)
    for action in actions:
        state, pose = world.observe()
        world.advance(action)
        states.append(state)
        poses.append(pose)
        stages.append(world.stages)
    if not world.stands:
        return None
    reached = np.array(stages)
    reward = reached.mean(axis=1, dtype=np.float32)
    return Demonstration(number, strategy, np.array(states), np.array(poses), actions, reward, reached[:, -1])


@lru_cache(maxsize=1)
def _arm() -> InverseKinematics:
    return InverseKinematics(model())


def features_of(kept: list[Demonstration]) -> dict[str, FeatureArrays]:
    """Feature key → names, [N, D] values, dtype, as the writer takes them. All but `strategy` have LeRobot's usual
    names."""
    lengths = [len(demonstration.action) for demonstration in kept]

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(demonstration, name) for demonstration in kept])

    return {
        STATE: (NAMES, joined("state"), "float32"),
        POSE: (POSE_NAMES, joined("pose"), "float32"),
        ACTION: (NAMES, joined("action"), "float32"),
        "next.reward": (None, joined("reward")[:, None], "float32"),
        "next.success": (None, joined("success")[:, None], "bool"),
        "next.done": (None, last_of(lengths), "bool"),
        "strategy": (None, np.repeat([d.strategy for d in kept], lengths)[:, None], "int64"),
    }


def _versions() -> dict[str, str]:
    arm_file()
    return versions()


SO101 = Demonstrator(demonstrate, features_of, card, _versions, FPS, TASK, "so101_follower")


def record_so101(
    out: Path,
    *,
    episodes: int = 50,
    seed: int = 0,
    workers: int = 2,
    on_episode: Callable[[int, int], None] | None = None,
) -> None:
    """Record SO-101 demonstrations into a new folder (see `recording.record`)."""
    record(SO101, out, episodes=episodes, seed=seed, workers=workers, on_episode=on_episode)
