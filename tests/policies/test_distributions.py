"""The mathematics of the policies that draw, with networks that know the answer; no training."""

import numpy as np
import pytest
import torch

from pipeline.policies.act import Act
from pipeline.policies.diffusion import Diffusion, kept_shares
from pipeline.policies.flow import Flow
from pipeline.policies.gmm import LEAST, Gmm
from pipeline.policies.networks import Shape
from pipeline.settings import settings_of

SHAPE = Shape(inputs=3, history=1, chunk=2, width=2, limit=np.full(4, 3.0, np.float32))
CLEAN = torch.tensor([[0.5, -1.0, 2.0, 0.0], [1.0, 1.5, -2.5, 0.25]])
INPUTS = torch.zeros(2, 3)


def build(policy, method: str, **settings):
    torch.manual_seed(0)
    return policy.build(settings_of(method, {"width": 8, **settings}), SHAPE).eval()


def test_noise_takes_over_step_by_step():
    kept = kept_shares(100)
    assert (kept[1:] < kept[:-1]).all()
    assert kept[0] > 0.999
    assert kept[-1] < 1e-5
    half, none = (np.cos((share + 0.008) / 1.008 * np.pi / 2) ** 2 for share in (0.5, 0.0))
    assert kept[49].item() == pytest.approx(half / none, rel=1e-5)


@pytest.mark.parametrize("sampling", [1, 5, 20])
def test_diffusion_with_a_network_that_knows_ends_at_the_clean_actions(sampling, monkeypatch):
    net = build(Diffusion, "diffusion", noise_steps=20, sampling_steps=sampling)

    def knows(inputs, points, step):
        kept = net.kept[step, None]
        noise = (points - kept.sqrt() * CLEAN) / (1 - kept).sqrt()
        return kept.sqrt() * noise - (1 - kept).sqrt() * CLEAN

    monkeypatch.setattr(net, "velocity", knows)
    torch.testing.assert_close(net.answer(INPUTS, torch.randn(2, 4)), CLEAN, atol=1e-3, rtol=1e-3)
    torch.manual_seed(1)
    assert net.loss(INPUTS, CLEAN, torch.ones(2, 4)) < 1e-5


def test_what_a_diffusion_thinks_of_stays_within_what_was_recorded(monkeypatch):
    net = build(Diffusion, "diffusion", noise_steps=20, sampling_steps=5)
    monkeypatch.setattr(net, "velocity", lambda inputs, points, step: torch.full_like(points, 1e6))
    assert net.answer(INPUTS, torch.randn(2, 4)).abs().max() <= 3.0


def test_a_flow_that_knows_the_way_arrives(monkeypatch):
    net = build(Flow, "flow", euler_steps=7)
    monkeypatch.setattr(net, "velocity", lambda inputs, points, time: (CLEAN - points) / (1 - time[:, None]))
    torch.testing.assert_close(net.draw(INPUTS, torch.randn(2, 4)), CLEAN)


def test_the_mixture_s_likelihood_is_the_one_in_torch():
    net = build(Gmm, "gmm", components=3, blocks=1)
    inputs = torch.randn(5, 3)
    targets = torch.randn(5, 4)
    weights, means, deviations = net._parts(inputs)
    assert deviations.min() >= LEAST
    mixture = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(logits=weights),
        torch.distributions.Independent(torch.distributions.Normal(means, deviations), 1),
    )
    expected = -mixture.log_prob(targets).sum() / 20
    torch.testing.assert_close(net.loss(inputs, targets, torch.ones(5, 4)), expected)
    masked = torch.ones(5, 4)
    masked[:, 2:] = 0
    changed = torch.cat([targets[:, :2], targets[:, 2:] + 9], dim=1)
    torch.testing.assert_close(net.loss(inputs, targets, masked), net.loss(inputs, changed, masked))


def test_components_are_drawn_by_their_weights(monkeypatch):
    net = build(Gmm, "gmm", components=2)
    shares, means = torch.tensor([[0.2, 0.8]]), torch.tensor([[[-1.0] * 4, [1.0] * 4]])

    def parts(inputs):
        count = len(inputs)
        return shares.log().expand(count, 2), means.expand(count, 2, 4), torch.full((count, 2, 4), 0.01)

    monkeypatch.setattr(net, "_parts", parts)
    drawn = net.draw(torch.zeros(4000, 3), torch.randn(4000, 5, generator=torch.Generator().manual_seed(0)))
    assert (drawn[:, 0] > 0).float().mean() == pytest.approx(0.8, abs=0.03)
    assert ((drawn > 0).all(1) | (drawn < 0).all(1)).all()
    torch.testing.assert_close(net.answer(torch.zeros(1, 3), None), torch.ones(1, 4))


def test_act_hides_what_lies_past_the_end_and_its_latent_is_pulled_to_its_prior():
    net = build(Act, "act", heads=2, layers=1, latent=3, dropout=0.0)
    inputs, targets, mask = torch.randn(6, 3), torch.randn(6, 4), torch.ones(6, 4)
    mask[:, 2:] = 0
    changed = torch.cat([targets[:, :2], targets[:, 2:] + 9], dim=1)
    losses = []
    for seen in (targets, changed):
        torch.manual_seed(3)
        losses.append(net.loss(inputs, seen, mask))
    torch.testing.assert_close(*losses)
    mean, log_variance = net._style_of(inputs, targets, mask)
    prior = torch.distributions.Normal(torch.zeros_like(mean), torch.ones_like(mean))
    styled = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    divergence = torch.distributions.kl_divergence(styled, prior).sum(1).mean()
    without = build(Act, "act", heads=2, layers=1, latent=3, dropout=0.0, kl=0.0)
    without.load_state_dict(net.state_dict())
    torch.manual_seed(3)
    torch.testing.assert_close(losses[0] - without.loss(inputs, targets, mask), 10 * divergence, rtol=1e-4, atol=1e-4)
