"""Training all seeds together: the same as one at a time, the same bytes again, and after a kill."""

import json

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from pipeline.errors import PolicyError, StoreError
from pipeline.policies import Plan
from pipeline.policies.batched import Stack
from pipeline.policies.fitting import Batches, Gather, Recipe, fit_stack, seed_losses
from pipeline.windows import make_windows
from tests.hand_made import STATE_ONLY, changed, random_walks, semantics

SMALL = Recipe(hidden=(16, 16), loss="l1", batch=8, learning_rate=1e-3, weight_decay=1e-4)


def lay(demos, episodes=(0, 1, 2), chunk=4, own_history=None):
    settings = {"statistics_episodes": episodes, "protocol": "strict", "history": 3, "chunk": chunk}
    return make_windows(demos, semantics(demos), STATE_ONLY, episodes, **settings, own_history=own_history)


@pytest.fixture
def windows():
    return lay(random_walks())


def test_batches_are_known_from_seed_and_step_alone():
    forwards, backwards = Batches(50, 8, (3, 4)), Batches(50, 8, (3, 4))
    seen = [forwards.at(step) for step in range(20)]
    for step in reversed(range(20)):
        np.testing.assert_array_equal(backwards.at(step), seen[step])
    np.testing.assert_array_equal(Batches(50, 8, (4,)).at(17)[0], seen[17][1])
    one_pass = np.concatenate(seen[:6], axis=1)
    assert all(len(set(row.tolist())) == 48 for row in one_pass)
    assert not np.array_equal(one_pass[0], one_pass[1])


def test_fewer_windows_than_a_batch_are_one_batch():
    np.testing.assert_array_equal(np.sort(Batches(5, 8, (0,)).at(3)), [[0, 1, 2, 3, 4]])


@pytest.mark.parametrize("own_history", [None, 1, 7])
def test_the_device_gathers_what_the_windows_say(own_history):
    windows = lay(random_walks(), episodes=(1, 3), own_history=own_history)
    index = np.random.default_rng(0).integers(0, len(windows), (2, 6))
    inputs, actions, mask = Gather(windows, torch.float32, "cpu")(torch.from_numpy(index))
    scaling = windows.normalizer
    for seed in range(2):
        seen, (recorded, inside) = windows.observations(index[seed]), windows.targets(index[seed])
        expected = scaling.observations.encode(seen.values).reshape(6, -1)
        np.testing.assert_array_equal(inputs[seed].numpy(), expected)
        got = actions[seed].numpy().reshape(6, 4, -1)
        np.testing.assert_array_equal(got[inside], scaling.actions.encode(recorded)[inside])
        np.testing.assert_array_equal(mask[seed].numpy().reshape(6, 4, -1)[..., 0] > 0, inside)


def huber(x: float) -> float:
    return x * x / 2 if abs(x) < 1 else abs(x) - 0.5


@pytest.mark.parametrize(("loss", "size"), [("l1", abs), ("squared", lambda x: x * x), ("huber", huber)])
def test_targets_past_the_end_do_not_count(loss, size):
    error = torch.tensor([[[1.0, -2.0, 5.0]], [[3.0, 4.0, -6.0]]])
    mask = torch.tensor([[[1.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]]])
    expected = [(size(1.0) + size(-2.0)) / 2, size(3.0)]
    assert seed_losses(error, mask, loss).tolist() == pytest.approx(expected)
    assert seed_losses(error, None, loss)[0].item() == pytest.approx((size(1.0) + size(-2.0) + size(5.0)) / 3)


def test_a_masked_action_cannot_change_the_weights():
    """The frame after an episode is another episode's: what is recorded there must not matter to windows before it."""
    demos = random_walks((12, 12, 12))
    first = fit_stack(lay(demos, (0,)), SMALL, Plan((0,), 20))[0]
    second = fit_stack(lay(changed(demos, [1, 2]), (0,)), SMALL, Plan((0,), 20))[0]
    for name, array in first.arrays().items():
        np.testing.assert_array_equal(array, second.arrays()[name])


def test_networks_start_as_pytorch_starts_them():
    stack = Stack.fresh((5, 7, 3), (11, 12), torch.float32, "cpu")
    for position, seed in enumerate((11, 12)):
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            layers = [torch.nn.Linear(5, 7), torch.nn.Linear(7, 3)]
        for layer, linear in enumerate(layers):
            torch.testing.assert_close(stack.weights[layer][position].T, linear.weight, rtol=1e-6, atol=1e-7)
            torch.testing.assert_close(stack.biases[layer][position, 0], linear.bias, rtol=1e-6, atol=1e-7)


def test_a_stack_answers_like_its_networks_one_by_one():
    stack = Stack.fresh((5, 7, 3), (0, 1, 2), torch.float64, "cpu")
    inputs = torch.randn(3, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    together = stack(inputs)
    for position in range(3):
        hidden = torch.relu(inputs[position] @ stack.weights[0][position] + stack.biases[0][position])
        torch.testing.assert_close(together[position], hidden @ stack.weights[1][position] + stack.biases[1][position])
        alone = stack.of_seed(position)
        torch.testing.assert_close(alone(inputs[position : position + 1])[0], together[position])
    assert stack.parameters_of_one == 5 * 7 + 7 + 7 * 3 + 3


def test_all_seeds_together_are_each_seed_alone(windows):
    together, curve = fit_stack(windows, SMALL, Plan((0, 1, 5), 50), torch.float64)
    for position, seed in enumerate((0, 1, 5)):
        alone, alone_curve = fit_stack(windows, SMALL, Plan((seed,), 50), torch.float64)
        for name, array in alone.arrays().items():
            np.testing.assert_allclose(array[0], together.arrays()[name][position], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(alone_curve.losses[0], curve.losses[position], rtol=1e-6)


def test_the_loop_is_plain_training(windows):
    """The same bytes as a dozen plain lines: nothing that is on offer to other networks touches this one."""
    stack = Stack.fresh((6, 16, 16, 8), (0, 1), torch.float32, "cpu")
    gather, batches = Gather(windows, torch.float32, "cpu"), Batches(len(windows), 8, (0, 1))
    optimizer = torch.optim.AdamW(list(stack.tensors.values()), lr=1e-3, weight_decay=1e-4, fused=True)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    for step in range(25):
        inputs, actions, mask = gather(torch.from_numpy(batches.at(step)))
        error = (stack(inputs) - actions).abs() * mask
        optimizer.zero_grad()
        (error.sum(dim=(1, 2)) / mask.sum(dim=(1, 2))).sum().backward()
        optimizer.step()
    torch.set_num_threads(threads)
    assert bytes_of(fit_stack(windows, SMALL, Plan((0, 1), 25))[0]) == bytes_of(stack)


def test_cpu_seconds_become_steps_that_are_recorded(windows, tmp_path):
    plan = Plan((0, 1), 10**9, cpu_seconds=0.2, recorded=tmp_path / "deeper" / "steps.json")
    stack, curve = fit_stack(windows, SMALL, plan)
    steps = json.loads(plan.recorded.read_text())["steps"]
    assert curve.steps[-1] == steps
    assert 20 < steps < 20_000
    assert bytes_of(stack) == bytes_of(fit_stack(windows, SMALL, plan)[0])
    assert bytes_of(stack) == bytes_of(fit_stack(windows, SMALL, Plan((0, 1), steps))[0])
    assert json.loads(plan.recorded.read_text())["steps"] == steps


def test_more_cpu_seconds_are_more_steps(windows):
    few, many = (fit_stack(windows, SMALL, Plan((0,), 1, cpu_seconds=s))[1].steps[-1] for s in (0.1, 1.0))
    assert 3 * few < many


def bytes_of(stack: Stack) -> list[bytes]:
    return [array.tobytes() for array in stack.arrays().values()]


def test_the_same_seed_gives_the_same_bytes(windows):
    first, second, other = (bytes_of(fit_stack(windows, SMALL, Plan((seed,), 30))[0]) for seed in (1, 1, 2))
    assert first == second
    assert first != other


class Killed(Exception):
    pass


def killed_at(step: int):
    def on_step(done: int, steps: int, loss: float) -> None:
        if done == step:
            raise Killed

    return on_step


@pytest.mark.parametrize("step", [1, 17, 40])
def test_a_killed_training_goes_on_to_the_same_bytes(windows, tmp_path, step):
    checkpoint = tmp_path / "unfinished" / "checkpoint.safetensors"
    more = {"checkpoint": checkpoint, "checkpoint_every_s": 0.0}
    with pytest.raises(Killed):
        fit_stack(windows, SMALL, Plan((0, 1), 40, **more, on_step=killed_at(step)))
    steps = []
    resumed, curve = fit_stack(windows, SMALL, Plan((0, 1), 40, **more, on_step=lambda done, *_: steps.append(done)))
    whole, whole_curve = fit_stack(windows, SMALL, Plan((0, 1), 40))
    assert bytes_of(resumed) == bytes_of(whole)
    assert steps == list(range(step + 1, 41))
    np.testing.assert_array_equal(curve.steps, whole_curve.steps)
    np.testing.assert_array_equal(curve.losses, whole_curve.losses)
    assert [path.name for path in checkpoint.parent.iterdir()] == ["checkpoint.safetensors"]


def test_a_checkpoint_of_another_training_is_not_used(windows, tmp_path):
    checkpoint = tmp_path / "checkpoint.safetensors"
    fit_stack(windows, SMALL, Plan((0,), 10, checkpoint=checkpoint, checkpoint_every_s=0.0))
    assert checkpoint.exists()
    other = lay(changed(random_walks(), [1]))
    mixed = fit_stack(other, SMALL, Plan((0,), 10, checkpoint=checkpoint))[0]
    assert bytes_of(mixed) == bytes_of(fit_stack(other, SMALL, Plan((0,), 10))[0])


@pytest.mark.parametrize("content", [b"", b"not safetensors at all", b"\xff" * 64])
def test_a_damaged_checkpoint_is_not_used(windows, tmp_path, content):
    checkpoint = tmp_path / "checkpoint.safetensors"
    checkpoint.write_bytes(content)
    stack = fit_stack(windows, SMALL, Plan((0,), 10, checkpoint=checkpoint))[0]
    assert bytes_of(stack) == bytes_of(fit_stack(windows, SMALL, Plan((0,), 10))[0])


def test_a_foreign_safetensors_file_is_not_used(windows, tmp_path):
    checkpoint = tmp_path / "checkpoint.safetensors"
    save_file({"x": np.zeros(3)}, checkpoint, metadata={"progress": json.dumps({"done": 3})})
    assert fit_stack(windows, SMALL, Plan((0,), 5, checkpoint=checkpoint))[1].steps.tolist() == [1, 2, 3, 4, 5]


def test_a_checkpoint_that_cannot_be_written_is_one_message(windows, tmp_path):
    (tmp_path / "file").write_text("in the way")
    plan = Plan((0,), 5, checkpoint=tmp_path / "file" / "checkpoint.safetensors", checkpoint_every_s=0.0)
    with pytest.raises(StoreError, match=r"checkpoint .* cannot be written .*Make room"):
        fit_stack(windows, SMALL, plan)


def test_a_loss_that_is_not_finite_stops_training():
    demos = random_walks()
    demos.columns["action"][4] = np.nan
    with pytest.raises(PolicyError, match=r"stopped at step .* losses of the seeds are .*demobench inspect"):
        fit_stack(lay(demos), SMALL, Plan((0,), 50))


def test_the_number_of_threads_is_put_back(windows):
    before = torch.get_num_threads()
    fit_stack(windows, SMALL, Plan((0,), 2, threads=before + 1))
    assert torch.get_num_threads() == before


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_a_device_that_is_not_there_is_refused(windows):
    with pytest.raises(PolicyError, match="finds no CUDA device"):
        fit_stack(windows, SMALL, Plan((0,), 2, device="cuda"))
    assert fit_stack(windows, SMALL, Plan((0,), 2, device="auto"))[1].steps.tolist() == [1, 2]


def test_long_trainings_keep_a_curve_of_bounded_length(windows):
    calls = []
    _, curve = fit_stack(windows, SMALL, Plan((0, 1), 450, on_step=lambda *call: calls.append(call)))
    assert len(curve.steps) == 150
    assert curve.losses.shape == (2, 150)
    assert [call[0] for call in calls] == curve.steps.tolist()
    assert calls[-1][:2] == (450, 450)
    assert curve.losses[:, -1].mean() < curve.losses[:, 0].mean()
