"""The fair energy score: against a loop, fair in the number of samples, and smallest for the true distribution."""

import numpy as np
import pytest

from pipeline.statistics.distributions import score_samples


def slow_scores(samples: np.ndarray, recorded: np.ndarray):
    """[M] for one seed, one anchor and one pair at a time."""
    count, anchors = samples.shape[:2]
    energy, of_mean, of_one = np.zeros(anchors), np.zeros(anchors), np.zeros(anchors)
    for m in range(anchors):
        to_truth = [np.linalg.norm(samples[i, m] - recorded[m]) for i in range(count)]
        apart = [np.linalg.norm(samples[i, m] - samples[j, m]) for i in range(count) for j in range(count) if i != j]
        energy[m] = np.mean(to_truth) - np.mean(apart) / 2
        of_one[m] = np.mean(to_truth)
        of_mean[m] = np.linalg.norm(samples[:, m].mean(axis=0) - recorded[m])
    return energy, of_mean, of_one


@pytest.mark.parametrize("count", [2, 3, 8])
def test_scores_agree_with_a_loop(count):
    generator = np.random.default_rng(count)
    samples, recorded = generator.normal(size=(2, count, 5, 3)), generator.normal(size=(5, 3))
    found = score_samples(samples, recorded)
    for seed in range(2):
        energy, of_mean, of_one = slow_scores(samples[seed], recorded)
        np.testing.assert_allclose(found.energy[seed], energy)
        np.testing.assert_allclose(found.of_mean[seed], of_mean)
        np.testing.assert_allclose(found.of_one[seed], of_one)


def test_it_is_fair_in_the_number_of_samples():
    generator = np.random.default_rng(0)
    recorded = generator.normal(size=(20_000, 2))
    means = [score_samples(generator.normal(size=(1, n, 20_000, 2)), recorded).energy.mean() for n in (2, 4, 16)]
    assert max(means) - min(means) < 0.02
    # E|x − y| − ½ E|x − x′| for x, y of one Gaussian in the plane: half the mean distance of two draws, √π / 2.
    assert means == pytest.approx([np.sqrt(np.pi) / 2] * 3, abs=0.015)


def two_modes(generator, size, *, apart=1.0, spread=0.2, share=0.5):
    side = np.where(generator.random(size) < share, apart, -apart)
    return (side + spread * generator.normal(size=size))[..., None]


def test_the_true_distribution_scores_best():
    """Too narrow, too wide, one mode only, the mean, the wrong shares: all are worse than the truth."""
    generator = np.random.default_rng(1)
    recorded, shape = two_modes(generator, 20_000), (1, 4, 20_000)
    wrong = {
        "narrow": two_modes(generator, shape, apart=0.7),
        "wide": two_modes(generator, shape, spread=0.8),
        "one mode": two_modes(generator, shape, share=1.0),
        "the mean": 0.2 * generator.normal(size=(*shape, 1)),
        "wrong shares": two_modes(generator, shape, share=0.75),
    }
    truth = score_samples(two_modes(generator, shape), recorded).energy.mean()
    for name, samples in wrong.items():
        assert score_samples(samples, recorded).energy.mean() > truth + 0.01, name


def test_wide_samples_win_the_best_of_k_but_not_the_energy_score():
    generator = np.random.default_rng(2)
    recorded = generator.normal(size=(5_000, 1))
    honest, wide = generator.normal(size=(1, 16, 5_000, 1)), 1.5 * generator.normal(size=(1, 16, 5_000, 1)) + 0.5
    assert score_samples(honest, recorded).energy.mean() < score_samples(wide, recorded).energy.mean()


def test_angles_are_wrapped():
    samples = np.array([np.pi - 0.1, -np.pi + 0.1]).reshape(1, 2, 1, 1)
    found = score_samples(samples, np.array([[np.pi]]), circular=np.array([True]))
    assert found.of_one[0, 0] == pytest.approx(0.1)
    assert found.of_mean[0, 0] == pytest.approx(0.0, abs=1e-9)
    assert found.energy[0, 0] == pytest.approx(0.1 - 0.2 / 2)
    plain = score_samples(samples, np.array([[np.pi]]))
    assert plain.of_mean[0, 0] == pytest.approx(np.pi)


def test_columns_are_scaled_and_dead_ones_left_out():
    generator = np.random.default_rng(3)
    samples, recorded = generator.normal(size=(1, 4, 6, 3)), generator.normal(size=(6, 3))
    found = score_samples(samples, recorded, scale=np.array([2.0, 0.5, np.nan]))
    expected = score_samples(samples[..., :2] / [2.0, 0.5], recorded[:, :2] / [2.0, 0.5])
    np.testing.assert_allclose(found.energy, expected.energy)
    np.testing.assert_allclose(found.of_mean, expected.of_mean)


def test_one_sample_is_not_enough_and_shapes_must_fit():
    with pytest.raises(ValueError, match="n ≥ 2"):
        score_samples(np.zeros((1, 1, 4, 2)), np.zeros((4, 2)))
    with pytest.raises(ValueError, match="must fit recorded"):
        score_samples(np.zeros((1, 3, 4, 2)), np.zeros((5, 2)))
