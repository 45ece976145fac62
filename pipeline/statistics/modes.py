"""Evidence of modes: did people do clearly different things at the same observation?

What belongs here: one small network with one Gaussian against the same network with a mixture (a mixture density network,
Bishop 1994), both scored on episodes that they did not see. What does not: floors (`floors`) and policies.

Four things are asked before modes are said to be there, because each alone is fooled:

gain         the mixture is more likely than one Gaussian on held-out episodes; so it is for skewed or heavy-tailed noise;
share        its density dips between two peaks at a share of the held-out states; so does one that imitates correlated or
             uniform noise;
dip          there, held-out actions are rarer in the dip than at the lower peak, which no density with one peak allows;
             but a network that cannot tell on which side of a jump it is will see both sides;
disagreement there, a state and its nearest neighbour of another episode lie on two sides of the dip about as often as the
             mixture expects; near a jump neighbours agree.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Any

import numpy as np

import pipeline.policies  # noqa: F401  before PyTorch is imported: how its threads wait
from pipeline.lerobot_format.quality import dead_columns
from pipeline.normalize import circular_columns, fit_normalizer
from pipeline.statistics.intervals import estimate_mean
from pipeline.types import ACTION, Demonstrations, ObservationSet, Semantics
from pipeline.windows import Windows, make_windows

FEWEST = 10
"""Episodes below which nothing is said."""
MOST_STATES = 20_000
"""About so many states train and are scored, the same share of every episode."""
COMPONENTS = 3
HIDDEN = (64, 64)
STEPS, BATCH, LEARNING_RATE, WEIGHT_DECAY = 800, 256, 4e-3, 1e-3
LOOK_EVERY = 25
"""Steps between two looks at the validation episodes; the best look is kept."""
SMALLEST_DEVIATION = 0.03
"""Of a component, in deviations of the action: narrower ones would resolve the steps of an encoder."""
DIP = 0.5
"""A dip is a density at most this share of the lower of the two peaks beside it: two equal Gaussians 3.3 deviations apart."""
SMALLEST_SIDE = 0.1
"""The mass that the density needs on either side of the dip."""
LEAST_SHARE, LEAST_DISAGREEMENT = 0.05, 0.5
"""What the share of states with a dip, and the disagreement there, must be above, interval and all."""
FULL_DISAGREEMENT = 0.95
"""What the interval of the disagreement must reach: near a jump neighbours disagree half as often as a mixture expects."""
MOST_ASKED = 2000
"""States with a dip, evenly taken, whose neighbours are looked for."""
GRID = 33

Estimate = tuple[float | None, tuple[float, float] | None]


@dataclass(frozen=True)
class ModesEvidence:
    """Whether demonstrations have several modes at one horizon, given an observation set; JSON-able by `asdict`.

    gain          nats a state by which the mixture is more likely than one Gaussian, mean over held-out episodes
    share         of the held-out states, those where the mixture's density has more than one peak
    dip           at those states: held-out actions at the lower peak less those in the dip, as a share of all actions there
    disagreement  at those states: neighbours on two sides of the dip, as a share of those that the mixture expects; 1 where
                  the mixture is right, near 0 where a jump in the mean is what it could not resolve
    interval …    95 %, over episodes, given the folds; None where fewer than five have such states
    found         all four stand out: gain and dip above 0, share above 0.05, disagreement above 0.5 and not below 0.95;
                  None where refused
    """

    observations: str
    horizon: int
    gain: float | None
    interval: tuple[float, float] | None
    share: float | None
    share_interval: tuple[float, float] | None
    dip: float | None
    dip_interval: tuple[float, float] | None
    disagreement: float | None
    disagreement_interval: tuple[float, float] | None
    found: bool | None
    words: str
    refused: str | None


@dataclass(frozen=True)
class _States:
    """n sampled states: anchors in `windows` [n], their episode [n], scaled targets [n, H, A], which of them exist [n, H]."""

    windows: Windows
    index: np.ndarray
    episode: np.ndarray
    targets: np.ndarray
    exists: np.ndarray


def evidence_of_modes(
    demos: Demonstrations,
    semantics: Semantics,
    observation_set: ObservationSet,
    *,
    history: int,
    horizons: Sequence[int],
    folds: int = 4,
    seed: int = 0,
    on_step: Callable[[int, int, float], None] | None = None,
) -> list[ModesEvidence]:
    """Is a mixture more likely than one Gaussian on held-out episodes, and does it really have several peaks?

    Parameters
    ----------
    history : the benchmark's: anchors start at frame history − 1. The set's own history, where it has one, is what is seen.
    horizons : steps ahead, 0 for the anchor's own frame.
    folds : every episode is scored by networks trained on the other folds (cross-fitting).
    on_step : called with (step, steps, loss) now and then.

    Returns
    -------
    One a horizon, in order. Action columns that are angles that wrap, or do not move, are left out. The same seed gives
    the same numbers on the same machine.

    Raises
    ------
    ConfigError : the observation set names a feature that the data set lacks.
    DatasetError : an episode is shorter than the history.
    """
    columns = _columns(demos, semantics)
    why = _refusal(demos, columns)
    if why is not None:
        return [_refused(observation_set.name, horizon, why) for horizon in horizons]
    random = np.random.default_rng(seed)
    states = _sample(demos, semantics, observation_set, history, tuple(horizons), columns, random)
    fold = random.permutation(np.arange(demos.episodes) % folds)
    report = _Progress(on_step, 2 * STEPS)
    inputs = [_inputs(states, np.flatnonzero(fold != f)) for f in range(folds)]
    parts = [_parts(fold, f, states.episode, random) for f in range(folds)]
    fits = [_fit(inputs, states, parts, components, seed, report) for components in (1, COMPONENTS)]
    found = [_judge(states, inputs[0], fits, h, horizon, observation_set.name) for h, horizon in enumerate(horizons)]
    return [replace(evidence, words=evidence.words + _left_out(demos, columns)) for evidence in found]


def _columns(demos: Demonstrations, semantics: Semantics) -> np.ndarray:
    """The action columns that a Gaussian can describe."""
    return np.flatnonzero(~circular_columns(demos, semantics, [ACTION]) & ~dead_columns(demos, ACTION))


def _left_out(demos: Demonstrations, columns: np.ndarray) -> str:
    names = [name for i, name in enumerate(demos.features[ACTION].names) if i not in columns]
    return f" (Without {', '.join(names)}: angles that wrap, or columns that do not move.)" if names else ""


def _refusal(demos: Demonstrations, columns: np.ndarray) -> str | None:
    if demos.episodes < FEWEST:
        return f"{demos.episodes} episodes are too few: evidence of modes needs {FEWEST}"
    if not len(columns):
        return "no action column moves, other than angles that wrap"
    return None


def _refused(name: str, horizon: int, why: str) -> ModesEvidence:
    words = f"Whether '{name}' leaves several modes at horizon {horizon} cannot be said: {why}."
    return ModesEvidence(name, horizon, *[None] * 8, None, words, why)


# states ---------------------------------------------------------------------------------------------------------------


def _sample(
    demos: Demonstrations,
    semantics: Semantics,
    observation_set: ObservationSet,
    history: int,
    horizons: tuple[int, ...],
    columns: np.ndarray,
    random: np.random.Generator,
) -> _States:
    """About MOST_STATES anchors, the same share of every episode; actions scaled to mean 0 and deviation 1.

    The scale of the actions is that of all episodes: it is common to both models and leaves their difference as it is.
    """
    everyone = range(demos.episodes)
    windows = make_windows(
        demos, semantics, observation_set, everyone, statistics_episodes=everyone, protocol="strict", history=history,
        chunk=1, own_history=observation_set.history,
    )  # fmt: skip
    share = min(1.0, MOST_STATES / len(windows))
    episode = np.searchsorted(demos.episode_starts, windows.anchors, side="right") - 1
    kept = [np.flatnonzero(episode == e) for e in everyone]
    chosen = [np.sort(random.choice(own, max(1, round(share * len(own))), replace=False)) for own in kept]
    index = np.concatenate(chosen)
    ahead = windows.anchors[index, None] + np.array(horizons)
    end = windows.end_frame[index, None]
    actions = _between_steps(demos.columns[ACTION][:, columns].astype(np.float64), random)
    scaled = (actions - actions.mean(axis=0)) / actions.std(axis=0)
    return _States(windows, index, episode[index], scaled[np.minimum(ahead, end - 1)].astype(np.float32), ahead < end)


def _between_steps(actions: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Actions [N, A] spread evenly over the step of their encoder, as densities of rounded numbers are learnt (Uria,
    Murray & Larochelle 2013); else every step would be a mode. Of numbers that are not rounded the step is next to nothing.
    """
    steps = [np.median(np.diff(np.unique(column))) for column in actions.T]
    return actions + random.uniform(-0.5, 0.5, actions.shape) * steps


def _inputs(states: _States, episodes: np.ndarray) -> np.ndarray:
    """[n, T · O'] what the networks see, scaled by the statistics of the episodes that train."""
    windows = states.windows
    scaler = fit_normalizer(
        windows.demos, windows.semantics, windows.observation_set.features, episodes.tolist(), protocol="strict"
    ).observations
    seen = scaler.encode(windows.observations(states.index).values)
    return seen.reshape(len(seen), -1)


def _parts(fold: np.ndarray, held_out: int, episode: np.ndarray, random: np.random.Generator) -> "_Parts":
    """Positions of the states that train, that say when to stop (a fifth of the other folds' episodes), and that score."""
    others = np.flatnonzero(fold != held_out)
    stops = np.isin(episode, random.choice(others, max(2, len(others) // 5), replace=False))
    scored = fold[episode] == held_out
    return np.flatnonzero(~scored & ~stops), np.flatnonzero(stops), np.flatnonzero(scored)


class _Progress:
    """Counts steps over both fits."""

    def __init__(self, on_step: Callable[[int, int, float], None] | None, steps: int):
        self.on_step, self.steps, self.done = on_step, steps, 0

    def __call__(self, steps: int, loss: float) -> None:
        self.done += steps
        if self.on_step is not None:
            self.on_step(self.done, self.steps, loss)


# networks -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mixtures:
    """Mixtures of C diagonal Gaussians: weight [n, …, C], mean [n, …, C, A], deviation [n, …, C, A]."""

    weight: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray

    def at(self, *index: Any) -> "Mixtures":
        return Mixtures(self.weight[index], self.mean[index], self.deviation[index])


_Parts = tuple[np.ndarray, np.ndarray, np.ndarray]
_Fit = tuple[np.ndarray, Mixtures]
"""Log-likelihood [n, H] and mixture [n, H, …] of every state, by the network that did not see its episode."""


class _Task:
    """What networks of C components learn: one network a fold, side by side in one stack.

    inputs a fold [n, I]      targets [n, H, A]      exists [n, H]      parts a fold: which states train, stop, score
    """

    def __init__(
        self, inputs: Sequence[np.ndarray], states: _States, parts: Sequence[_Parts], components: int, seed: int
    ):
        import torch

        self.inputs = [torch.from_numpy(values) for values in inputs]
        self.targets, self.exists = torch.from_numpy(states.targets), torch.from_numpy(states.exists)
        self.parts, self.seed = [[torch.from_numpy(part) for part in own] for own in parts], seed
        horizons, self.actions = states.targets.shape[1:]
        self.shape = (horizons, components, 1 + 2 * self.actions)

    def fresh(self) -> Any:
        """Networks that have learnt nothing. Components that start in one place would stay there: their means are spread."""
        import torch

        from pipeline.policies.batched import Stack

        sizes = (self.inputs[0].shape[1], *HIDDEN, math.prod(self.shape))
        stack = Stack.fresh(sizes, [self.seed + f for f in range(len(self.parts))], torch.float32, "cpu")
        if self.shape[1] > 1:
            generator = torch.Generator().manual_seed(self.seed)
            with torch.no_grad():
                means = stack.biases[-1].unflatten(-1, self.shape)[..., 1 : 1 + self.actions]
                means += torch.randn(means.shape, generator=generator)
        return stack

    def unpack(self, output: Any) -> tuple[Any, Any, Any]:
        """The networks' output → log weights [..., H, C], means and deviations [..., H, C, A]."""
        output = output.unflatten(-1, self.shape)
        mean, log_deviation = output[..., 1:].split(self.actions, dim=-1)
        return output[..., 0].log_softmax(dim=-1), mean, SMALLEST_DEVIATION + log_deviation.clamp(-8.0, 3.0).exp()

    def log_likelihood(self, output: Any, index: Any) -> Any:
        """[..., H] nats of the targets of some states."""
        log_weight, mean, deviation = self.unpack(output)
        z = (self.targets[index].unsqueeze(-2) - mean) / deviation
        each = -0.5 * z.square() - deviation.log() - 0.5 * math.log(2 * math.pi)
        return (log_weight + each.sum(dim=-1)).logsumexp(dim=-1)

    def losses(self, output: Any, index: Any) -> Any:
        """[F] minus the mean log-likelihood of states [F, B] whose actions exist."""
        there = self.exists[index]
        total = (self.log_likelihood(output, index) * there).sum(dim=(1, 2))
        return -total / there.sum(dim=(1, 2)).clamp(min=1)


def _fit(
    inputs: Sequence[np.ndarray],
    states: _States,
    parts: Sequence[_Parts],
    components: int,
    seed: int,
    report: _Progress,
) -> _Fit:
    """Train the networks of all folds on one core, and ask each about the episodes that it did not see."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        task = _Task(inputs, states, parts, components, seed)
        return _score(task, _train(task, report))
    finally:
        torch.set_num_threads(threads)


def _train(task: _Task, report: _Progress) -> Any:
    """Adam on batches of each fold's own states; every network is returned as it was at its best look."""
    import torch

    stack = task.fresh()
    tensors = list(stack.tensors.values())
    optimizer = torch.optim.AdamW(tensors, lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    generator = torch.Generator().manual_seed(task.seed)
    best, kept = torch.full((len(task.parts),), math.inf), [tensor.detach().clone() for tensor in tensors]
    for step in range(1, STEPS + 1):
        index = torch.stack([own[torch.randint(len(own), (BATCH,), generator=generator)] for own, _, _ in task.parts])
        batch = torch.stack([values[own] for values, own in zip(task.inputs, index, strict=True)])
        optimizer.zero_grad(set_to_none=True)
        task.losses(stack(batch), index).sum().backward()
        torch.nn.utils.clip_grad_norm_(tensors, 5.0)
        optimizer.step()
        schedule.step()
        if step % LOOK_EVERY == 0:
            losses = _look(task, stack)
            better = losses < best
            best = torch.where(better, losses, best)
            for copy, tensor in zip(kept, tensors, strict=True):
                copy[better] = tensor.detach()[better]
            report(LOOK_EVERY, float(losses.mean()))
    return type(stack)(tuple(kept[0::2]), tuple(kept[1::2]))


def _look(task: _Task, stack: Any) -> Any:
    """[F] losses on the episodes that say when to stop."""
    import torch

    with torch.no_grad():
        return torch.cat(
            [
                task.losses(stack.of_seed(f)(task.inputs[f][stops][None]), stops[None])
                for f, (_, stops, _) in enumerate(task.parts)
            ]
        )


def _score(task: _Task, stack: Any) -> _Fit:
    """Every state by the network that did not see its episode."""
    import torch

    n, (horizons, components, _) = len(task.targets), task.shape
    likelihood, weight = np.empty((n, horizons)), np.empty((n, horizons, components))
    mean, deviation = np.empty((2, n, horizons, components, task.actions))
    with torch.no_grad():
        for f, (_, _, scored) in enumerate(task.parts):
            output, own = stack.of_seed(f)(task.inputs[f][scored][None])[0], scored.numpy()
            likelihood[own] = task.log_likelihood(output, scored).numpy()
            log_weight, *rest = task.unpack(output)
            weight[own], mean[own], deviation[own] = log_weight.exp().numpy(), *(part.numpy() for part in rest)
    return likelihood, Mixtures(weight, mean, deviation)


# modes ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Dips:
    """Where the densities of n mixtures dip between two peaks.

    there [n] bool      line [n, A] the direction in which the two peaks lie apart
    places [n, 3]       along that line (a · line): the lower peak, the dip, the higher peak
    """

    there: np.ndarray
    line: np.ndarray
    places: np.ndarray


def find_dips(mixture: Mixtures) -> Dips:
    """Look for a dip between any two component means.

    Along the line that best separates two components (their difference of means over the sum of their variances) the
    mixture is one in one dimension, whose density is looked at on a grid between the two means. Components are not modes:
    two of them may share one peak (Ray & Lindsay 2005).
    """
    n, components, actions = mixture.mean.shape
    ratio, line, places = np.full(n, np.inf), np.zeros((n, actions)), np.zeros((n, 3))
    for j, k in combinations(range(components), 2):
        found = _dip_between(mixture, j, k)
        better = found[0] < ratio
        for kept, new in zip((ratio, line, places), found, strict=True):
            kept[better] = new[better]
    return Dips(ratio <= DIP, line, places)


def _dip_between(mixture: Mixtures, j: int, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[n] density in the dip over that of the lower peak (inf where a side has too little mass), the line, the places."""
    variance = mixture.deviation[:, j] ** 2 + mixture.deviation[:, k] ** 2
    line = (mixture.mean[:, k] - mixture.mean[:, j]) / variance
    centre, spread = _along(mixture, line)
    grid = centre[:, [j]] + (centre[:, [k]] - centre[:, [j]]) * np.linspace(0, 1, GRID)
    z = (grid[:, :, None] - centre[:, None]) / spread[:, None]
    density = (mixture.weight[:, None] / spread[:, None] * np.exp(-0.5 * z**2)).sum(axis=2)
    left = np.maximum.accumulate(density, axis=1)
    right = np.maximum.accumulate(density[:, ::-1], axis=1)[:, ::-1]
    ratio = density / np.maximum(np.minimum(left, right), 1e-300)
    rows, lowest = np.arange(len(grid)), ratio.argmin(axis=1)
    before = np.arange(GRID) <= lowest[:, None]
    first, second = np.where(before, density, -1.0).argmax(axis=1), np.where(before, -1.0, density).argmax(axis=1)
    swap = density[rows, first] > density[rows, second]
    order = np.where(swap, second, first), lowest, np.where(swap, first, second)
    places = np.stack([grid[rows, place] for place in order], axis=1)
    below = _mass_below(mixture, line, places[:, 1])
    enough = np.minimum(below, 1 - below) >= SMALLEST_SIDE
    return np.where(enough, ratio[rows, lowest], np.inf), line, places


def _along(mixture: Mixtures, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[n, C] means and deviations of the components along a line [n, A]."""
    spread = np.sqrt(np.einsum("nca,na->nc", mixture.deviation**2, line**2))
    return np.einsum("nca,na->nc", mixture.mean, line), np.maximum(spread, 1e-12)


def _mass_below(mixture: Mixtures, line: np.ndarray, place: np.ndarray) -> np.ndarray:
    """[n] the mass of each mixture on the low side of a place [n] on its line."""
    from scipy.special import ndtr

    centre, spread = _along(mixture, line)
    return (mixture.weight * ndtr((place[:, None] - centre) / spread)).sum(axis=1)


def _emptier(dips: Dips, actions: np.ndarray) -> np.ndarray:
    """[n] +1 where the recorded action lies at the lower peak, −1 where it lies in the dip, in bands of one width, else 0."""
    lower, dip, higher = dips.places.T
    half = np.minimum(np.abs(dip - lower), np.abs(higher - dip)) / 2
    where = np.einsum("na,na->n", actions, dips.line)
    return (np.abs(where - lower) < half).astype(float) - (np.abs(where - dip) < half)


def _neighbours_apart(
    dips: Dips, mixture: Mixtures, actions: np.ndarray, inputs: np.ndarray, episode: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For states with a dip: their episode, whether their neighbour lies beyond the dip, and how likely the mixture has it.

    The neighbour is the nearest state of another episode. Both actions are looked at along the state's own line.
    """
    from pipeline.statistics.neighbours import find_neighbours

    asked = np.flatnonzero(dips.there)
    asked = asked[:: max(1, math.ceil(len(asked) / MOST_ASKED))]
    if not len(asked):
        return asked, asked, asked
    _, lengths = np.unique(episode, return_counts=True)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    nearest = find_neighbours(inputs, starts, asked, 0, [0], keep=1)[0].frames[:, 0]
    line, dip = dips.line[asked], dips.places[asked, 1]
    own, other = (np.einsum("na,na->n", actions[i], line) < dip for i in (asked, nearest))
    p, q = (_mass_below(mixture.at(i), line, dip) for i in (asked, nearest))
    return episode[asked], own != other, p * (1 - q) + q * (1 - p)


def _judge(states: _States, inputs: np.ndarray, fits: Sequence[_Fit], h: int, horizon: int, name: str) -> ModesEvidence:
    """What both fits say at one horizon, by held-out episode."""
    there = np.flatnonzero(states.exists[:, h])
    episode, actions = states.episode[there], states.targets[there, h].astype(np.float64)
    if len(np.unique(episode)) < FEWEST:
        return _refused(name, horizon, f"fewer than {FEWEST} episodes are longer than {horizon} frames")
    (one, _), (several, mixtures) = fits
    mixture = mixtures.at(there, h)
    dips = find_dips(mixture)
    evidence = [
        _over_episodes((several - one)[there, h], episode),
        _over_episodes(dips.there.astype(float), episode),
        _over_episodes(_emptier(dips, actions)[dips.there], episode[dips.there]),
        _disagreement(*_neighbours_apart(dips, mixture, actions, inputs[there], episode)),
    ]
    least = (0.0, LEAST_SHARE, 0.0, LEAST_DISAGREEMENT)
    stands_out = [i is not None and i[0] > x for (_, i), x in zip(evidence, least, strict=True)]
    stands_out[3] = stands_out[3] and evidence[3][1][1] >= FULL_DISAGREEMENT
    words = _words(name, horizon, stands_out, evidence[0][0], evidence[1][0])
    return ModesEvidence(name, horizon, *chain.from_iterable(evidence), all(stands_out), words, None)


def _over_episodes(values: np.ndarray, episode: np.ndarray) -> Estimate:
    """The mean over episodes of each episode's mean, and its interval."""
    if not len(values):
        return None, None
    _, position = np.unique(episode, return_inverse=True)
    found = estimate_mean((np.bincount(position, weights=values) / np.bincount(position))[None])
    return found.value, found.interval


def _disagreement(episode: np.ndarray, apart: np.ndarray, expected: np.ndarray) -> Estimate:
    """Neighbours apart over those expected, as a ratio of sums over episodes."""
    if not len(episode):
        return None, None
    _, position = np.unique(episode, return_inverse=True)
    seen, likely = (np.bincount(position, weights=values) for values in (apart.astype(float), expected))
    found = estimate_mean((seen / likely)[None], likely)
    return found.value, found.interval


def _words(name: str, horizon: int, stands_out: Sequence[bool], gain: float, share: float) -> str:
    """One sentence, with the first reason where no modes are found."""
    at = f"With '{name}' at horizon {horizon}"
    if all(stands_out):
        return (
            f"{at} people did clearly different things in {100 * share:.0f} % of the states: a mixture is {gain:.2f} nats a "
            "state more likely than one Gaussian on held-out episodes, and has more than one peak there."
        )
    why = (
        "a mixture is not clearly more likely than one Gaussian on held-out episodes",
        f"a mixture is more likely than one Gaussian ({gain:.2f} nats a state), but has more than one peak in hardly any state",
        f"a mixture is more likely than one Gaussian ({gain:.2f} nats a state), but held-out actions do not clearly avoid the "
        "dips of its density, so that skewed, correlated or flat noise would explain it",
        "where a mixture has two peaks, neighbouring states agree too often on one of them, so that a jump in what people did "
        "would explain it",
    )
    return f"{at} there is no evidence of several modes: {why[list(stands_out).index(False)]}."
