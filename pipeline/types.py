"""Records that cross the borders between rooms. They hold and check; they compute next to nothing.

The letters, the same everywhere:

    N frames of a data set      E episodes          M anchors          B anchors of one batch
    T frames of history         K actions a chunk   H horizons         S seeds
    A action columns            P columns of `observation.state`        O columns of an observation set

A *frame* is one row of a recording, an *episode* one demonstration. An *anchor* is the frame at which a policy is asked;
horizon h = 0 is the action recorded at the anchor's own frame. Frames are numbered through the whole data set (0 … N−1,
"global"); episodes by position (0 … E−1), not by the recorded `episode_index`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

ACTION = "action"
STATE = "observation.state"

ActionKind = Literal["position", "velocity", "delta", "other"]
Protocol = Literal["strict", "notebook"]


@dataclass(frozen=True)
class Feature:
    """One feature of a data set: `names` and `units` have one entry a column; a unit is None where it is not known."""

    key: str
    names: tuple[str, ...]
    units: tuple[str | None, ...]


@dataclass(frozen=True)
class Camera:
    """A camera stream as `info.json` declares it. `present` says whether the files were there when it was read."""

    key: str
    height: int
    width: int
    codec: str | None
    present: bool


@dataclass(frozen=True)
class ColumnChoice:
    """What a user says about the columns and episodes of a data set; the default leaves them as they are recorded.

    state     features that, side by side, are the state; None: `observation.state`, else what is plainly meant
    action    features that, side by side, are the action; None: `action`, else what is plainly meant
    units     of the columns of action and state: one for all of them, or by column name
    features  name → a parquet file with one value a frame, joined as a feature of that name
    exclude   recorded `episode_index` of episodes that are left out, ascending
    """

    state: tuple[str, ...] | None = None
    action: tuple[str, ...] | None = None
    units: str | Mapping[str, str] | None = None
    features: Mapping[str, Path] = field(default_factory=dict)
    exclude: tuple[int, ...] = ()


AS_RECORDED = ColumnChoice()


@dataclass(frozen=True)
class Demonstrations:
    """Demonstrations in memory: one array a feature, episodes one after another.

    columns         feature key → [N, D] float32 (only features with numbers; never images)
    features        feature key → names and units of its D columns
    episode_starts  [E + 1] int64, episode e is frames episode_starts[e] … episode_starts[e + 1] − 1
    episode_ids     [E] int64, the recorded `episode_index`
    timestamps      [N] float64, seconds from the start of the episode, as recorded
    tasks           the task of each episode, in words ("" where there is none)
    revision        the Hub commit, where there is one
    content_hash    sha256 over the arrays above, names and fps: equal for equal demonstrations whatever the file layout
    warnings        what differed from the format's promises without making a number wrong
    excluded        recorded `episode_index` of the episodes that the user left out
    """

    name: str
    source: str
    revision: str | None
    fps: float
    robot_type: str | None
    columns: Mapping[str, np.ndarray]
    features: Mapping[str, Feature]
    episode_starts: np.ndarray
    episode_ids: np.ndarray
    timestamps: np.ndarray
    tasks: tuple[str, ...]
    cameras: tuple[Camera, ...]
    warnings: tuple[str, ...]
    content_hash: str
    excluded: tuple[int, ...] = ()

    @property
    def frames(self) -> int:
        return int(self.episode_starts[-1])

    @property
    def episodes(self) -> int:
        return len(self.episode_starts) - 1

    @property
    def lengths(self) -> np.ndarray:
        """[E] frames of each episode."""
        return np.diff(self.episode_starts)

    @property
    def episode_of_frame(self) -> np.ndarray:
        """[N] the position of the episode each frame belongs to."""
        return np.repeat(np.arange(self.episodes), self.lengths)

    @property
    def frame_in_episode(self) -> np.ndarray:
        """[N] each frame's number within its episode."""
        return np.arange(self.frames) - np.repeat(self.episode_starts[:-1], self.lengths)

    def episode(self, position: int) -> slice:
        """The global frames of one episode."""
        return slice(int(self.episode_starts[position]), int(self.episode_starts[position + 1]))


@dataclass(frozen=True)
class Semantics:
    """What the columns mean, guessed or set (`lerobot_format.quality.resolve_semantics`).

    kinds         [A] the kind of every action column
    state_column  [A] the column of `observation.state` that a position or velocity action commands, else None
    circular      feature key → [D] bool, true for angles that wrap; they enter networks and distances as sine and
                  cosine, and errors on them are wrapped to (−π, π]
    tracking_lag  [A] mean |a_t − s_t| over all frames for position columns, in their unit, else None
    warnings      where a guess was unsure, dead columns, an uneven clock
    """

    kinds: tuple[ActionKind, ...]
    state_column: tuple[int | None, ...]
    circular: Mapping[str, tuple[bool, ...]]
    tracking_lag: tuple[float | None, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class ObservationSet:
    """The features a policy sees, by name: `pose = ["observation.state", "observation.environment_state"]`.

    history  the frames of them that it sees, oldest first; None: as many as the benchmark's history
    """

    name: str
    features: tuple[str, ...]
    history: int | None = None


@dataclass(frozen=True)
class Fold:
    """Episode positions, sorted, that train and that are held out. They never overlap."""

    train: tuple[int, ...]
    test: tuple[int, ...]


@dataclass(frozen=True)
class Split:
    """One or more folds, seeded; `hash` covers the content hash of the demonstrations and every fold."""

    folds: tuple[Fold, ...]
    seed: int
    hash: str

    @property
    def held_out(self) -> list[int]:
        """The episodes (positions) that a fold holds out, ascending."""
        return sorted(episode for fold in self.folds for episode in fold.test)


@dataclass(frozen=True)
class Observations:
    """What policies are asked with, offline and in roll-outs alike; raw units, nothing normalised.

    values           [B, T, O] the observation set's columns (features in the set's order), oldest frame first
    state            [B, T, P] `observation.state`, for baselines that move the arm's own state; P may be 0
    previous_action  [B, A] the action recorded one frame before; NaN at the first frame of an episode
    anchors          [B] global frame numbers, or None in a roll-out
    look             (camera or None for the only one, pixels) → [B, T, pixels, pixels, 3] uint8, decoded when it is asked;
                     None where nothing can be looked at, as in a roll-out
    """

    values: np.ndarray
    state: np.ndarray
    previous_action: np.ndarray
    anchors: np.ndarray | None = None
    look: Callable[[str | None, int], np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True)
class Predictions:
    """What one policy with one observation set predicted at every held-out anchor, raw units.

    anchors  [M] global frames, fold by fold      fold  [M]
    actions  [S, M, K, A] float32; K is the policy's chunk, or the longest horizon scored where it has none
    """

    policy: str
    observations: str
    seeds: tuple[int, ...]
    anchors: np.ndarray
    fold: np.ndarray
    actions: np.ndarray

    def in_frames(self, frames: slice) -> np.ndarray:
        """Positions (into `anchors`) of the anchors inside a range of global frames, in time order."""
        inside = np.flatnonzero((self.anchors >= frames.start) & (self.anchors < frames.stop))
        return inside[np.argsort(self.anchors[inside], kind="stable")]


@dataclass(frozen=True)
class EpisodeErrors:
    """Errors on held-out anchors, summed within each episode: every metric is made from these.

    episodes  [E] positions      fold [E]       anchors [E, H] how many anchors have a target at horizon h
    absolute  [S, E, H, A] Σ|error|             squared [S, E, H, A] Σ error²
    l2        [S, E, H] Σ Euclidean norm of the error over action columns
    scale     [E, A] standard deviation of the training actions of that episode's fold; NaN for dead columns
    """

    episodes: np.ndarray
    fold: np.ndarray
    anchors: np.ndarray
    absolute: np.ndarray
    squared: np.ndarray
    l2: np.ndarray
    scale: np.ndarray


@dataclass(frozen=True)
class Neighbourhood:
    """The frames around one probe: global frames [n], their actions [n, A], the probe's own frame."""

    probe: int
    frames: np.ndarray
    actions: np.ndarray


@dataclass(frozen=True)
class RadiusFloor:
    """The notebook's floor (biased, kept to reproduce published numbers); NaN values where no probe counted.

    probes             probes that had enough neighbours
    median_neighbours  frames in the median group, the probe included
    mean, p90          of the distances (L2) of actions to their own group's mean, in `unit`
    """

    observations: str
    horizon: int
    radius: float
    scaled: bool
    probes: int
    median_neighbours: float
    mean: float
    p90: float
    unit: str | None
    crowded: Neighbourhood | None
    refused: str | None


@dataclass(frozen=True)
class FloorEstimate:
    """How small the error of a deterministic policy of an observation set can get, or why that cannot be said.

    loss         rmse (of the squared error), mae and l2, as the metrics of the same names
    value        the floor; for `pair_distance` the lower end of where it lies; None where refused
    upper        the upper end of where it lies; None for `gamma`, which estimates the floor itself
    interval     95 %: of the value, or of the whole span from value to upper
    below        where refused: what the floor does not exceed (one-sided 95 %), if that can be said
    wrong        what extrapolation may be wrong by, on the squared scale (Γ, or D₀²); part of the interval
    influence    [E] how much each episode moved the estimate on the squared scale (Γ, or D₀²)
    counted_twice  the part of Σ influence² that is counted twice (`floors.standard_error`)
    nearest      the mean distance of the nearest neighbours, in deviations of one input column
    """

    observations: str
    history: int
    horizon: int
    loss: Literal["rmse", "mae", "l2"]
    estimator: Literal["gamma", "pair_distance"]
    value: float | None
    upper: float | None
    interval: tuple[float, float] | None
    below: float | None
    refused: str | None
    wrong: float
    influence: np.ndarray
    counted_twice: float
    nearest: float


@dataclass(frozen=True)
class Execution:
    """How a policy's chunks are carried out (`pipeline.execution` says what goes together).

    execute   actions carried out of each chunk before the policy is asked again; None: the usual 8, or as many as there are
    ensemble  the policy is asked at every frame, and what all answers say of a frame is averaged
    delay     frames from a question to its answer
    carry_on  where the robot has not moved since the last question, the answer to that one goes on
    """

    execute: int | None = None
    ensemble: bool = False
    delay: int = 0
    carry_on: bool = False


AS_USUAL = Execution()


@dataclass(frozen=True)
class Scenes:
    """What there was to see of the first few roll-outs, and what the policy meant to do: enough to draw them again.

    shown   feature key → [S, L, D] float32, all that the simulator shows of a frame (NaN after the end)
    asked   [Q] frames at which the policy was asked
    chunks  [S, Q, K, A] float32, what it answered then (NaN after the end)
    """

    shown: Mapping[str, np.ndarray]
    asked: np.ndarray
    chunks: np.ndarray

    def first(self, count: int) -> "Scenes":
        """The same of fewer start states."""
        return Scenes({key: values[:count] for key, values in self.shown.items()}, self.asked, self.chunks[:count])


@dataclass(frozen=True)
class Rollouts:
    """Closed-loop results of one network (one training seed of fold 0) from numbered start states.

    start_states  [R] numbers       success [R] bool       best_reward [R] in 0 … 1       steps [R]
    best_coverage [R] in 0 … 1, NaN where the simulator has none
    paths         [R, L, 2] where the end effector went (NaN after the end), for pictures; None where not two-dimensional
    stages        [R, G] bool, which stages of the task each episode came to; None where the simulator has none
    stage_names   [G], earliest first
    execution     how its chunks were carried out
    interventions [R] frames in which the safety layer stepped in (`safety.Guard` says when)
    corrections   [R] the sum over those frames of how far it changed what was asked for, in ranges of a column
    stopped       [R] why it stopped the robot (`safety.RUNS`: it did not)
    seed          the training seed; 0 of what is not trained
    scenes        of the first few start states, to draw them again; None where they were not kept
    """

    simulator: str
    simulator_version: str
    policy: str
    observations: str
    start_states: np.ndarray
    success: np.ndarray
    best_reward: np.ndarray
    best_coverage: np.ndarray
    steps: np.ndarray
    paths: np.ndarray | None
    stages: np.ndarray | None = None
    stage_names: tuple[str, ...] = ()
    execution: Execution = AS_USUAL
    interventions: np.ndarray | None = None
    corrections: np.ndarray | None = None
    stopped: np.ndarray | None = None
    seed: int = 0
    scenes: Scenes | None = None

    @property
    def stage_counts(self) -> list[int]:
        """[G] how many episodes came to each stage; empty where there are none."""
        return [] if self.stages is None else self.stages.sum(axis=0).tolist()
