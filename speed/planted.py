"""Clean recordings of a made-up arm, and faults to plant in copies of any recording.

What belongs here: what a fault does to the arrays, and which check should find it where. What does not: counting
(inspect_faults.py) and the detectors themselves.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pipeline.types import ACTION, STATE, Demonstrations, Feature

FPS = 30.0
JOINTS = 5


# Clean recordings -----------------------------------------------------------------------------------------------------


def made_arm(episodes: int, seed: int) -> Demonstrations:
    """A leader moves an arm of five joints and a gripper from a resting pose to an object, and on to a goal.

    The follower is 2 to 5 frames late, smooths, sticks where it is told less than an encoder's step, and is read in such
    steps (0.09 degrees); the gripper stops at the object it holds, whatever it is told. Episodes rest for up to half a
    second at either end; the clock is off by up to 2 ms a frame.
    """
    random = np.random.default_rng([seed, episodes])
    late, smooth = random.integers(2, 6), random.uniform(0.3, 0.7, JOINTS + 1)
    rest = random.uniform(-60, 60, JOINTS + 1)
    goal = rest + random.choice([-1, 1], JOINTS + 1) * random.uniform(30, 80, JOINTS + 1)
    tells, does, times = [], [], []
    for _ in range(episodes):
        told, width = _commands(random, rest, goal)
        tells.append(told)
        does.append(_followed(told, late, smooth, width))
        times.append(np.maximum.accumulate(np.arange(len(told)) / FPS + random.uniform(-1e-3, 1e-3, len(told))))
    return _demonstrations(tells, does, times)


def _commands(random: np.random.Generator, rest: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, float]:
    """[n, JOINTS + 1] degrees: through a few way points, smoothly; and how wide the gripper is on the object."""
    object_at = 0.5 * (rest + goal) + random.normal(0, 12, JOINTS + 1)
    points = np.stack([rest, object_at, object_at, goal + random.normal(0, 5, JOINTS + 1), rest])
    points = points + random.normal(0, 1, points.shape)
    open_to, width = 60.0, random.uniform(15, 25)
    points[:, -1] = [5.0, open_to, 5.0, 5.0, 5.0]
    pieces = [np.repeat(points[:1], random.integers(3, 15), axis=0)]
    for one, other in pairwise(points):
        tau = np.linspace(0, 1, random.integers(25, 70))[:, None]
        pieces.append(one + (other - one) * (10 * tau**3 - 15 * tau**4 + 6 * tau**5))
    pieces.append(np.repeat(points[-1:], random.integers(3, 15), axis=0))
    told = np.concatenate(pieces)
    tremor = np.cumsum(random.normal(0, 0.05, told.shape), axis=0)
    tremor -= np.linspace(0, 1, len(told))[:, None] * tremor[-1]
    still = np.concatenate([[False], np.abs(np.diff(told, axis=0)).max(axis=1) < 0.02])
    tremor[still] = tremor[np.maximum.accumulate(np.where(still, 0, np.arange(len(told))))[still]]
    return np.round((told + tremor) / 0.09) * 0.09, width


def _followed(told: np.ndarray, late: int, smooth: np.ndarray, width: float) -> np.ndarray:
    state = told.copy()
    for t in range(1, len(told)):
        wanted = told[max(0, t - late)]
        step = smooth * (wanted - state[t - 1])
        state[t] = state[t - 1] + np.where(np.abs(wanted - state[t - 1]) < 0.3, 0, step)
        if 0.35 * len(told) < t < 0.85 * len(told):
            state[t, -1] = max(state[t, -1], width)
    return np.round(state / 0.09) * 0.09


def _demonstrations(tells: list[np.ndarray], does: list[np.ndarray], times: list[np.ndarray]) -> Demonstrations:
    names = (*(f"joint_{j}" for j in range(JOINTS)), "gripper")
    columns = {ACTION: np.concatenate(tells).astype(np.float32), STATE: np.concatenate(does).astype(np.float32)}
    lengths = [len(each) for each in tells]
    return Demonstrations(
        name="arm", source="made:arm", revision=None, fps=FPS, robot_type=None, columns=columns,
        features={key: Feature(key, names, ("deg",) * len(names)) for key in columns},
        episode_starts=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64), episode_ids=np.arange(len(lengths)),
        timestamps=np.concatenate(times), tasks=("put it there",) * len(lengths), cameras=(), warnings=(),
        content_hash="0" * 64,
    )  # fmt: skip


def some_episodes(demos: Demonstrations, positions: np.ndarray) -> Demonstrations:
    """Only these episodes, in this order."""
    return rebuilt(demos, [cut(demos, int(position)) for position in positions])


# Planting -------------------------------------------------------------------------------------------------------------


@dataclass
class Episode:
    """One episode's own arrays, to be changed."""

    number: int
    columns: dict[str, np.ndarray]
    times: np.ndarray
    task: str

    def take(self, frames: np.ndarray) -> "Episode":
        """These frames, at the times of as many first frames."""
        columns = {key: values[frames] for key, values in self.columns.items()}
        tick = float(np.median(np.diff(self.times)))
        return Episode(self.number, columns, np.arange(len(frames)) * tick, self.task)


def cut(demos: Demonstrations, position: int) -> Episode:
    frames = demos.episode(position)
    columns = {key: values[frames].copy() for key, values in demos.columns.items()}
    return Episode(int(demos.episode_ids[position]), columns, demos.timestamps[frames].copy(), demos.tasks[position])


def rebuilt(demos: Demonstrations, episodes: list[Episode]) -> Demonstrations:
    """Demonstrations of changed episodes."""
    lengths = [len(episode.times) for episode in episodes]
    columns = {key: np.concatenate([episode.columns[key] for episode in episodes]) for key in demos.columns}
    return replace(
        demos, columns=columns, episode_starts=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        episode_ids=np.array([episode.number for episode in episodes]),
        timestamps=np.concatenate([episode.times for episode in episodes]),
        tasks=tuple(episode.task for episode in episodes),
    )  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong in one episode.

    check   the check that should find it          words  what goes wrong
    change  (demonstrations, the episode to change, random) → what it becomes (two episodes where one is repeated)
    needs_commands  it is only a fault where actions are positions of state columns
    """

    name: str
    check: str
    words: str
    change: Callable[[Demonstrations, Episode, np.random.Generator], list[Episode]]
    needs_commands: bool = False

    def plant(
        self, demos: Demonstrations, position: int, random: np.random.Generator
    ) -> tuple[Demonstrations, set[int]]:
        """The changed copy, and the numbers of the episodes that may be named for it."""
        episodes = [cut(demos, each) for each in range(demos.episodes)]
        changed = self.change(demos, episodes[position], random)
        copies = [replace(each, number=int(demos.episode_ids.max()) + 1 + n) for n, each in enumerate(changed[1:])]
        episodes[position] = changed[0]
        return rebuilt(demos, [*episodes, *copies]), {changed[0].number, *(each.number for each in copies)}


def _busiest(demos: Demonstrations, episode: Episode, frames: int) -> tuple[int, int, int]:
    """The state column that moves most against its range within so many frames, and where: column, first, stop."""
    values = episode.columns[STATE]
    frames = min(frames, len(values) - 2)
    scale = np.ptp(demos.columns[STATE], axis=0)
    travel = np.abs(values[frames:] - values[:-frames]) / np.where(scale > 0, scale, np.inf)
    travel[:, _grippers(demos)] = 0
    first, column = np.unravel_index(int(np.argmax(travel)), travel.shape)
    return int(column), int(first), int(first) + frames


def _grippers(demos: Demonstrations) -> list[int]:
    return [i for i, name in enumerate(demos.features[STATE].names) if "gripper" in name]


def _freeze(seconds: float, every: bool = False):
    def change(demos, episode, random):
        column, first, stop = _busiest(demos, episode, max(5, round(seconds * demos.fps)))
        columns = slice(None) if every else column
        episode.columns[STATE][first:stop, columns] = episode.columns[STATE][first, columns]
        return [episode]

    return change


def _constant(demos, episode, random):
    column, first, _ = _busiest(demos, episode, len(episode.times) // 2)
    episode.columns[STATE][:, column] = episode.columns[STATE][first, column]
    return [episode]


def _repeat(shift: int = 0, noise: float = 0.0):
    def change(demos, episode, random):
        copy = episode.take(np.arange(shift, len(episode.times) - shift))
        for key in (ACTION, STATE):
            scale = np.ptp(demos.columns[key], axis=0)
            copy.columns[key] = (
                copy.columns[key] + noise * scale * random.normal(size=copy.columns[key].shape)
            ).astype(np.float32)
        return [episode, copy]

    return change


def _leap(feature: str, share: float, stays: bool):
    def change(demos, episode, random):
        values = episode.columns[feature]
        column = _busiest(demos, episode, 5)[0] if feature == STATE else int(random.integers(values.shape[1]))
        at = int(random.integers(len(values) // 4, 3 * len(values) // 4))
        leap = share * np.ptp(demos.columns[feature][:, column]) * random.choice([-1, 1])
        values[at : len(values) if stays else at + 1, column] += leap
        return [episode]

    return change


def _lose_frames(seconds: float, least: int = 6):
    def change(demos, episode, random):
        lost = max(least, round(seconds * demos.fps))
        at = len(episode.times) // 2
        keep = np.r_[0:at, at + lost : len(episode.times)]
        return [replace(episode, columns={k: v[keep] for k, v in episode.columns.items()}, times=episode.times[keep])]

    return change


def _clock(change_times: Callable[[np.ndarray], np.ndarray]):
    return lambda demos, episode, random: [replace(episode, times=change_times(episode.times))]


def _stand_still(times: np.ndarray) -> np.ndarray:
    times[len(times) // 2 : len(times) // 2 + 3] = times[len(times) // 2]
    return times


def _wait(seconds: float, at_start: bool = False):
    def change(demos, episode, random):
        frames, last = round(seconds * demos.fps), len(episode.times) - 1
        before, after = (frames, 0) if at_start else (0, frames)
        return [episode.take(np.clip(np.arange(-before, last + 1 + after), 0, last))]

    return change


def _stay(demos, episode, random):
    return [episode.take(np.zeros(len(episode.times), np.int64))]


def _cut_off(demos, episode, random):
    return [episode.take(np.arange(5))]


def _stretch(demos, episode, random):
    return [episode.take(np.repeat(np.arange(len(episode.times)), 5))]


def _elsewhere(demos, episode, random):
    column, *_ = _busiest(demos, episode, len(episode.times) // 2)
    for key in (ACTION, STATE):
        if episode.columns[key].shape[1] == episode.columns[STATE].shape[1]:
            episode.columns[key][:, column] += np.float32(0.8 * np.ptp(demos.columns[key][:, column]))
    return [episode]


def _late(seconds: float):
    def change(demos, episode, random):
        frames = max(4, round(seconds * demos.fps))
        values = episode.columns[STATE]
        values[:] = np.concatenate([np.repeat(values[:1], frames, axis=0), values[:-frames]])
        return [episode]

    return change


def _unplugged(demos, episode, random):
    """The commands of one joint are those of another time."""
    column, *_ = _busiest(demos, episode, len(episode.times) // 2)
    episode.columns[ACTION][:, column] = episode.columns[ACTION][::-1, column]
    return [episode]


FAULTS = (
    Fault("joint frozen for 3 s", "frozen", "one joint's state repeats for 3 s where it moves most", _freeze(3.0), True),
    Fault("joint frozen for 1 s", "frozen", "the same for 1 s", _freeze(1.0), True),
    Fault("telemetry frozen for 1 s", "frozen", "all of the state repeats for 1 s", _freeze(1.0, every=True), True),
    Fault("telemetry frozen for 0.5 s", "frozen", "the same for 0.5 s", _freeze(0.5, every=True), True),
    Fault("joint frozen throughout", "frozen", "one joint's state is one number in the whole episode", _constant),
    Fault("episode repeated", "duplicate", "an episode is there twice", _repeat()),
    Fault("repeated, shifted and cut", "duplicate", "a copy lacks five frames at either end", _repeat(shift=5)),
    Fault("repeated with noise", "duplicate", "a copy with noise of 0.1 % of the range", _repeat(noise=0.001)),
    Fault("repeated with more noise", "duplicate", "a copy with noise of 0.3 % of the range", _repeat(noise=0.003)),
    Fault("state leaps for a frame", "jump", "one state is off by 30 % of its range for one frame", _leap(STATE, 0.3, False)),
    Fault("state leaps less", "jump", "the same by 15 %", _leap(STATE, 0.15, False)),
    Fault("action leaps and stays", "jump", "one action is off by 60 % of its range from a frame on", _leap(ACTION, 0.6, True)),
    Fault("frames lost, 0.3 s", "clock", "0.3 s of frames (at least six) are missing", _lose_frames(0.3)),
    Fault("three frames lost", "clock", "three frames are missing", _lose_frames(0, least=3)),
    Fault("clock stands still", "clock", "three frames have one time", _clock(_stand_still)),
    Fault("clock at another rate", "clock", "the episode's clock runs 1.5 times as slowly", _clock(lambda times: times * 1.5)),
    Fault("waits 5 s at the end", "idle", "the last frame repeats for 5 s", _wait(5.0)),
    Fault("waits 5 s at the start", "idle", "the first frame repeats for 5 s", _wait(5.0, at_start=True)),
    Fault("waits 2.5 s at the start", "idle", "the same for 2.5 s", _wait(2.5, at_start=True)),
    Fault("nothing moves", "short", "the first frame throughout", _stay),
    Fault("cut off after 5 frames", "short", "five frames are left", _cut_off),
    Fault("five times as long", "outlier", "every frame five times", _stretch),
    Fault("another pose", "outlier", "one joint is off by 80 % of its range throughout", _elsewhere),
    Fault("state 0.3 s late", "tracking", "the state is stored 0.3 s late against actions", _late(0.3), True),
    Fault("state 0.2 s late", "tracking", "the same by 0.2 s, or four frames", _late(0.2), True),
    Fault("joint does not follow", "tracking", "one joint's commands run backwards", _unplugged, True),
)  # fmt: skip
"""Faults of one episode. Those of a whole data set are below."""


def saturate(demos: Demonstrations) -> Demonstrations:
    """The first action column is clipped at its 90th percentile in all episodes."""
    values = demos.columns[ACTION].copy()
    values[:, 0] = np.minimum(values[:, 0], np.quantile(values[:, 0], 0.9))
    return replace(demos, columns={**demos.columns, ACTION: values})


def swap_fps(demos: Demonstrations) -> Demonstrations:
    """meta/ says twice as many frames a second as there are."""
    return replace(demos, fps=2 * demos.fps)


def unplug(demos: Demonstrations) -> Demonstrations:
    """The last state column is one number, give or take the last bit, in all episodes."""
    values = demos.columns[STATE].copy()
    values[:, -1] = values[0, -1]
    values[::7, -1] = np.nextafter(values[0, -1], np.float32(np.inf))
    return replace(demos, columns={**demos.columns, STATE: values})


def in_radians(demos: Demonstrations) -> Demonstrations:
    """States are in radians, actions in degrees."""
    values = (demos.columns[STATE] * np.pi / 180).astype(np.float32)
    return replace(demos, columns={**demos.columns, STATE: values})


def delay_actions(demos: Demonstrations) -> Demonstrations:
    """Actions are stored eight frames too late in all episodes, later than the states that answer them."""
    episodes = [cut(demos, each) for each in range(demos.episodes)]
    for episode in episodes:
        values = episode.columns[ACTION]
        values[:] = np.concatenate([np.repeat(values[:1], 8, axis=0), values[:-8]])
    return rebuilt(demos, episodes)


def misspell(demos: Demonstrations) -> Demonstrations:
    """One episode's task is written with a capital and a full stop."""
    task = demos.tasks[0] or "push the block"
    return replace(demos, tasks=(task.capitalize() + ".", *[task] * (demos.episodes - 1)))


WHOLE = {
    "one action clipped": ("saturated", saturate), "fps doubled": ("clock", swap_fps), "a joint dead": ("dead", unplug),
    "states in radians": ("label", in_radians), "actions 8 frames late": ("tracking", delay_actions),
    "a task written in two ways": ("label", misspell),
}  # fmt: skip
"""Faults of a whole data set: name → (check, change)."""
