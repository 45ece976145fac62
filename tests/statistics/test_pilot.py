"""The pilot regression: the obvious fit, and that it has not seen what it is asked about."""

import numpy as np

from pipeline.statistics.pilot import FOLDS, PENALTIES, fit_pilot, waves

EPISODES, FRAMES = 20, 15


def recorded(seed=0, noise=0.3):
    """[N, 2] states, [N, 2] actions, [N] episode."""
    random = np.random.default_rng(seed)
    episode = np.repeat(np.arange(EPISODES), FRAMES)
    states = random.normal(size=(len(episode), 2))
    mean = np.column_stack([np.sin(2 * states[:, 0]), states[:, 1] ** 2])
    return states, mean + noise * random.normal(size=mean.shape), episode


def test_it_is_ridge_on_the_episodes_of_the_other_folds():
    states, actions, episode = recorded()
    pilot = fit_pilot(states, actions, episode, EPISODES)
    f, g = 1, 3
    kept = ~np.isin(pilot.fold[episode], (f, g))
    seen = waves(states)
    size = (seen**2).sum(axis=1).mean() / seen.shape[1]
    for column in range(2):
        found = pilot.weights[pilot.pair[f, g]][:, column]
        fits = []
        for penalty in PENALTIES:
            # Ridge as least squares with rows of its own, every frame of these even episodes weighing 1 / N.
            extra = np.sqrt(penalty * size * len(episode)) * np.eye(seen.shape[1])[1:]
            rows, wanted = (
                np.concatenate([seen[kept], extra]),
                np.concatenate([actions[kept, column], np.zeros(len(extra))]),
            )
            fits.append(np.linalg.lstsq(rows, wanted, rcond=None)[0])
        assert min(np.abs(found - fit).max() for fit in fits) < 1e-6


def test_a_pair_is_asked_of_a_regression_that_saw_neither():
    states, actions, episode = recorded()
    before = fit_pilot(states, actions, episode, EPISODES)
    changed = actions.copy()
    changed[episode == 4] += 0.01 * np.random.default_rng(1).normal(size=(FRAMES, 2))
    after = fit_pilot(states, changed, episode, EPISODES)
    asked, others = np.flatnonzero(episode == 4), np.flatnonzero(episode != 4)[None].repeat(FRAMES, axis=0)
    found = [pilot.differences(states, episode, asked, others) for pilot in (before, after)]
    np.testing.assert_array_equal(*found)
    elsewhere = np.flatnonzero(before.fold[episode] != before.fold[4])[:1]
    other = np.flatnonzero((before.fold[episode] != before.fold[4]) & (episode != episode[elsewhere[0]]))[None]
    found = [pilot.differences(states, episode, elsewhere, other) for pilot in (before, after)]
    assert np.abs(found[0] - found[1]).max() > 0, "where it may be seen, it is"


def test_it_follows_what_is_smooth():
    states, actions, episode = recorded(noise=0.3)
    pilot = fit_pilot(states, actions, episode, EPISODES)
    assert (pilot.error > 0.07).all()
    assert (pilot.error < 0.4 * actions.var(axis=0)).all()
    nobody = fit_pilot(states, np.zeros_like(actions), episode, EPISODES)
    assert (nobody.error == 0).all()


def test_episodes_without_rows_are_left_out_of_the_deal():
    states, actions, episode = recorded()
    there = episode % 2 == 0
    pilot = fit_pilot(states[there], actions[there], episode[there], EPISODES)
    counts = np.bincount(pilot.fold[::2], minlength=FOLDS)
    assert counts.tolist() == [2] * FOLDS
    assert np.isfinite(pilot.weights).all()
