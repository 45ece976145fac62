"""Learning curves with a known future: made up from a formula with realistic noise, and of cheap learners on made-up data."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.statistics.curve import answer
from pipeline.statistics.curve_errors import CurveErrors

FIVE_FOLDS = {"sizes": (5, 10, 20, 40), "episodes": 50, "folds": 5}
ONE_FOLD = {"sizes": (20, 41, 82, 164), "episodes": 42, "folds": 1}


def made_curve(
    rng: np.random.Generator, truth: Callable[[float], float], *, sizes: Sequence[int], episodes: int, folds: int,
    seeds: int = 5, paired: float = 0.08, orders: float = 0.02, between_seeds: float = 0.02,
) -> CurveErrors:  # fmt: skip
    """Errors with mean `truth(n)`. Noise as shares of it, like that of `mlp_k01` on pusht_sim: 40 % between episodes, `paired`
    between sizes within an episode, `orders` and `between_seeds` shared by all episodes of a fold.
    """
    fold = np.arange(episodes) % folds
    level = 0.4 * rng.normal(size=episodes)
    values = []
    for size in sizes:
        rows = 3 if folds == 1 and size < sizes[-1] else 1
        luck = np.sqrt(1 - size / sizes[-1]) * orders * rng.normal(size=(rows, 1, folds))
        training = between_seeds * rng.normal(size=(rows, seeds, folds))
        own = paired * rng.normal(size=episodes) + 0.05 * rng.normal(size=(rows, seeds, episodes))
        values.append(truth(size) * (1 + level + own + (luck + training)[:, :, fold]))
    return CurveErrors(tuple(sizes), tuple(values), fold)


def words_of_many(
    truth: Callable[[float], float], repeats: int, *, more: int = 50, **design
) -> tuple[dict[str, float], float, float]:
    """The share of each word, the true gain as a share of the present error, and how often its limits held it."""
    rng = np.random.default_rng(0)
    full = design["sizes"][-1]
    gain = truth(full) - truth(full + more)
    said = [answer(made_curve(rng, truth, **design), "first_step_mae", more=more) for _ in range(repeats)]
    words = {word: sum(a.word == word for a in said) / repeats for word in ("yes", "no", "cannot tell")}
    held = sum(a.interval[0] <= gain <= a.interval[1] for a in said) / repeats
    return words, gain / truth(full), held


@dataclass(frozen=True)
class Task:
    """A made-up task and a cheap learner of it: ridge regression on cosines with random directions, which are its seed."""

    inputs: int
    wiggles: float
    noise: float
    features: int = 60
    frames: int = 15

    def episode_data(self, rng: np.random.Generator, episodes: int) -> tuple[np.ndarray, np.ndarray]:
        """[E, T, D] states, around a place of its own in every episode, and [E, T] actions."""
        place = rng.normal(size=(episodes, 1, self.inputs))
        states = place + 0.5 * rng.normal(size=(episodes, self.frames, self.inputs))
        clean = np.sin(self.wiggles * states).sum(axis=2) / np.sqrt(self.inputs)
        scale = self.noise * rng.uniform(0.6, 1.4, size=(episodes, 1))
        return states, clean + scale * rng.normal(size=clean.shape)

    def fitted(self, states: np.ndarray, actions: np.ndarray, seed: int) -> Callable[[np.ndarray], np.ndarray]:
        rng = np.random.default_rng(seed)
        directions, phase = rng.normal(size=(self.inputs, self.features)), rng.uniform(0, 2 * np.pi, self.features)

        def seen(x: np.ndarray) -> np.ndarray:
            return np.cos(self.wiggles * x @ directions + phase)

        flat = seen(states.reshape(-1, self.inputs))
        weights = np.linalg.solve(flat.T @ flat + 0.3 * np.eye(self.features), flat.T @ actions.ravel())
        return lambda x: seen(x) @ weights

    def errors(self, train, test, seeds: Sequence[int]) -> np.ndarray:
        """[S, E] mean absolute errors of held-out episodes."""
        return np.stack([np.abs(self.fitted(*train, seed)(test[0]) - test[1]).mean(axis=1) for seed in seeds])

    def true_gain(self, full: int, more: int, repeats: int = 30) -> float:
        """The share of the error that `more` episodes take away, on average over training sets and a large test set."""
        rng = np.random.default_rng(99)
        test = self.episode_data(rng, 300)
        found = np.zeros(2)
        for _ in range(repeats):
            states, actions = self.episode_data(rng, full + more)
            seeds = [int(rng.integers(1 << 30))]
            for i, size in enumerate((full, full + more)):
                found[i] += self.errors((states[:size], actions[:size]), test, seeds).mean()
        return float(1 - found[1] / found[0])

    def curve(self, seed: int, *, sizes: Sequence[int], episodes: int, folds: int, seeds: int = 3) -> CurveErrors:
        """The curve of one data set, with every fold's own order (three orders where there is one fold)."""
        rng = np.random.default_rng(seed)
        everything = episodes if folds > 1 else episodes + sizes[-1]
        states, actions = self.episode_data(rng, everything)
        fold = np.arange(episodes) % folds
        values = []
        for size in sizes:
            rows = 3 if folds == 1 and size < sizes[-1] else 1
            of_size = np.empty((rows, seeds, episodes))
            for number in range(folds):
                held_out = np.flatnonzero(fold == number)
                rest = np.setdiff1d(np.arange(everything), held_out)
                for order in range(rows):
                    taken = np.random.default_rng([seed, number, order]).permutation(rest)[:size]
                    runs = [1000 * number + s for s in range(seeds)]
                    found = self.errors((states[taken], actions[taken]), (states[held_out], actions[held_out]), runs)
                    of_size[order][:, held_out] = found
            values.append(of_size)
        return CurveErrors(tuple(sizes), tuple(values), fold)
