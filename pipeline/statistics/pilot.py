"""What a smooth regression already explains, taken away before neighbours are compared.

What belongs here: a regression of the actions on what is seen, fitted without the episodes that it is asked about. What does
not: what is made of the differences that it leaves (`floors`).

Two neighbours do different things for two reasons: they are not quite in the same place, and people disagree. For any function
m̂ of the place that knows nothing of either action, the actions less m̂ disagree as the actions do, and the difference of
places counts only as far as m̂ is wrong. That is prewhitening (Press & Tukey 1956): flatten what can be flattened, then
extrapolate what is left. A bad m̂ gains little, and where it adds more than it takes away `floors` refuses. One that has seen
either action would take noise away with the mean; so episodes are dealt into folds, and a pair is asked of the regression that
saw neither's fold (cross-fitting: Chernozhukov et al. 2018).

The regression is ridge on random cosines (Rahimi & Recht 2007): sums over frames, so that all pairs of folds cost little more
than one fit.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from threadpoolctl import threadpool_limits

FOLDS = 5
WAVES = 200
FREQUENCIES = (0.35, 1.0)
"""Of the random directions, half each: radians for one deviation of all inputs together."""
PENALTIES = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
"""What is tried, in mean squared columns; the one with the smallest error on held-out folds is taken, an action column each."""
BLOCK = 20_000


@dataclass(frozen=True)
class Pilot:
    """Ridge regressions of the actions [A], one for each pair of folds that it has not seen.

    fold      [E] of each episode
    pair      [F, F] which regression has seen neither of two folds (on the diagonal: has not seen that one)
    weights   [P, 1 + D + WAVES, A]
    error     [A] mean squared error on held-out folds, an episode counting once
    """

    fold: np.ndarray
    pair: np.ndarray
    weights: np.ndarray
    error: np.ndarray

    def differences(self, inputs: np.ndarray, episode: np.ndarray, asked: np.ndarray, others: np.ndarray) -> np.ndarray:
        """[M, K, A] what is expected at frames `asked` [M] less what is at frames `others` [M, K], by regressions that saw
        neither's fold; inputs [N, D], episode [N]."""
        frames, where = np.unique(np.concatenate([asked[:, None], others], axis=1), return_inverse=True)
        expected = self._expected(inputs[frames])
        where = where.reshape(len(asked), -1)
        pair = self.pair[self.fold[episode[asked]][:, None], self.fold[episode[others]]]
        return expected[pair, where[:, :1]] - expected[pair, where[:, 1:]]

    def _expected(self, inputs: np.ndarray) -> np.ndarray:
        """[P, n, A] float32, a block of frames at a time."""
        found = np.empty((len(self.weights), len(inputs), self.weights.shape[2]), np.float32)
        for start in range(0, len(inputs), BLOCK):
            block = slice(start, start + BLOCK)
            found[:, block] = waves(inputs[block]) @ self.weights
        return found


@threadpool_limits.wrap(limits=1)
def fit_pilot(inputs: np.ndarray, actions: np.ndarray, episode: np.ndarray, episodes: int) -> Pilot:
    """Fit the regressions, on one core: on systems of this size, threads wait for each other for most of their time.

    Parameters
    ----------
    inputs : [n, D], columns of about unit deviation.
    actions : [n, A].
    episode : [n] position of each row's episode, of `episodes`; an episode counts once, however many rows it has.
    """
    fold = _deal(episode, episodes)
    seen, actions = waves(inputs), actions.astype(np.float64)
    weight = 1.0 / np.bincount(episode, minlength=episodes)[episode]
    weight /= weight.sum()
    rows = [np.flatnonzero(fold[episode] == f) for f in range(FOLDS)]
    weighted = seen * weight[:, None]
    squares = np.stack([weighted[own].T @ seen[own] for own in rows])
    products = np.stack([weighted[own].T @ actions[own] for own in rows])
    penalty = np.diag(np.arange(seen.shape[1]) > 0) * np.trace(squares.sum(axis=0)) / seen.shape[1]

    def solve(left_out: tuple[int, int], strength: float) -> np.ndarray:
        kept = [f for f in range(FOLDS) if f not in left_out]
        return np.linalg.solve(squares[kept].sum(axis=0) + strength * penalty, products[kept].sum(axis=0))

    errors = np.zeros((len(PENALTIES), actions.shape[1]))
    for row, strength in zip(errors, PENALTIES, strict=True):
        for f, own in enumerate(rows):
            row += weight[own] @ (actions[own] - seen[own] @ solve((f, f), strength)) ** 2
    best = errors.argmin(axis=0)
    pairs = list(combinations_with_replacement(range(FOLDS), 2))
    weights, pair = np.empty((len(pairs), seen.shape[1], actions.shape[1])), np.empty((FOLDS, FOLDS), np.int64)
    for number, (f, g) in enumerate(pairs):
        pair[f, g] = pair[g, f] = number
        for chosen in np.unique(best):
            columns = best == chosen
            weights[number][:, columns] = solve((f, g), PENALTIES[chosen])[:, columns]
    return Pilot(fold, pair, weights, errors.min(axis=0))


def _deal(episode: np.ndarray, episodes: int) -> np.ndarray:
    """[E] the fold of each episode: those that have rows are dealt evenly."""
    there = np.unique(episode)
    fold = np.zeros(episodes, np.int64)
    fold[there] = np.random.default_rng(0).permutation(np.arange(len(there)) % FOLDS)
    return fold


def waves(inputs: np.ndarray) -> np.ndarray:
    """[n, 1 + D + WAVES] float64: one, the inputs, and cosines of random directions of them."""
    inputs = inputs.astype(np.float64)
    random = np.random.default_rng(0)
    directions = random.normal(size=(inputs.shape[1], WAVES)) / np.sqrt(inputs.shape[1])
    directions *= np.resize(FREQUENCIES, WAVES)
    cosines = np.cos(inputs @ directions + random.uniform(0, 2 * np.pi, WAVES))
    return np.concatenate([np.ones((len(inputs), 1)), inputs, np.sqrt(2 / WAVES) * cosines], axis=1)
