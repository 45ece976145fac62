"""A small arm without a fault, and how its episodes are taken apart and put together again with one.

What does not belong here: what is expected of a detector (the tests).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.inspection.finding import Finding
from pipeline.inspection.look import Inspection, inspect
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.types import ACTION, STATE, Demonstrations, Feature

FPS, JOINTS = 20.0, 3
NAMES = (*(f"joint_{joint}.pos" for joint in range(JOINTS)), "gripper.pos")


@dataclass
class Take:
    """One episode's own arrays, to be changed: action and state [n, JOINTS + 1], seconds [n], the task in words."""

    action: np.ndarray
    state: np.ndarray
    seconds: np.ndarray
    task: str = "put it there"

    def frames(self, places: Sequence[int] | slice, *, new_clock: bool = False) -> "Take":
        seconds = np.arange(len(self.seconds[places])) / FPS if new_clock else self.seconds[places].copy()
        return Take(self.action[places].copy(), self.state[places].copy(), seconds, self.task)


def arm_takes(episodes: int = 16, seed: int = 0) -> list[Take]:
    """Joints that go 30 to 50 degrees out, on and back, smoothly, each half of the way to its command in every frame,
    after up to half a second of rest; a gripper that is switched. States are read in steps of 0.05 degrees.
    """
    random = np.random.default_rng(seed)
    takes = []
    for _ in range(episodes):
        moving = int(random.integers(110, 150))
        tau = np.linspace(0, 1, moving)[:, None]
        wide = np.array([50.0, 40.0, 30.0]) + random.normal(0, 4, JOINTS)
        path = wide * (
            np.sin(np.pi * tau) + 0.4 * np.sin(2 * np.pi * tau + np.arange(JOINTS)) - 0.4 * np.sin(np.arange(JOINTS))
        )
        path += random.normal(0, 2, JOINTS)
        grip = np.where((tau > random.uniform(0.3, 0.4)) & (tau < random.uniform(0.7, 0.8)), 0.0, 40.0)
        rests = random.integers(3, 10, 2)
        action = np.pad(np.hstack([path, grip]), ((rests[0], rests[1]), (0, 0)), mode="edge")
        state = action.copy()
        for t in range(1, len(action)):
            state[t] = state[t - 1] + 0.5 * (action[t - 1] - state[t - 1])
        state = np.round((state + random.normal(0, 0.01, state.shape)) / 0.05) * 0.05
        takes.append(Take(action, state, np.arange(len(action)) / FPS))
    return takes


def joined(
    takes: Sequence[Take], *, fps: float = FPS, first_id: int = 10, names: Sequence[str] = NAMES
) -> Demonstrations:
    """Episodes one after another; recorded numbers count on from `first_id`, so that they are no positions."""
    columns = {
        ACTION: np.concatenate([take.action for take in takes]).astype(np.float32),
        STATE: np.concatenate([take.state for take in takes]).astype(np.float32),
    }
    lengths = [len(take.seconds) for take in takes]
    return Demonstrations(
        name="arm", source="made:arm", revision=None, fps=fps, robot_type="made", columns=columns,
        features={key: Feature(key, tuple(names), (None,) * len(names)) for key in columns},
        episode_starts=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        episode_ids=np.arange(len(takes)) + first_id, timestamps=np.concatenate([take.seconds for take in takes]),
        tasks=tuple(take.task for take in takes), cameras=(), warnings=(), content_hash="0" * 64,
    )  # fmt: skip


def look(takes_or_demos: Sequence[Take] | Demonstrations, **options) -> Inspection:
    demos = takes_or_demos if isinstance(takes_or_demos, Demonstrations) else joined(takes_or_demos, **options)
    return inspect(demos, resolve_semantics(demos, kind="position", circular=[]))


def found(takes_or_demos: Sequence[Take] | Demonstrations, check: str, **options) -> list[Finding]:
    """What one check says."""
    return [finding for finding in look(takes_or_demos, **options).findings if finding.check == check]


def only(takes: Sequence[Take], check: str, place: int, **options) -> Finding:
    """The one finding of a check, which must be about the episode at this place; no check may blame another episode."""
    findings = look(takes, **options).findings
    blamed = {finding.episode for finding in findings} - {None}
    assert blamed == {place + 10}, [f"{f.check} {f.episode}: {f.words}" for f in findings]
    mine = [finding for finding in findings if finding.check == check and finding.episode == place + 10]
    assert mine, [f"{f.check} {f.episode}: {f.words}" for f in findings]
    return mine[0]
