"""Train every kind of network on a device that there is not, in a process of its own: `python -m tests.policies.pretended_device`.

The device is a name that PyTorch lets programs define, its tensors are fake: they have a shape and a device and no numbers. An
operation on tensors of different devices raises as it does on a GPU. Nothing can be read out of them, so losses are not
logged; the name stays with the process, hence one of its own. What is seen here: no step mixes devices. What is
not: numbers, and bfloat16, which PyTorch multiplies on devices that it knows.
"""

from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch._subclasses.fake_tensor import FakeTensorDeviceMismatchError, FakeTensorMode, unset_fake_temporarily
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from pipeline.lerobot_format.read import read_dataset
from pipeline.policies import networks
from pipeline.policies.fitting import Training
from pipeline.policies.flow import _Flow
from tests.policies import test_image
from tests.policies.test_methods import NETWORKS, train

DEVICE = "pretended"
PLAIN = {"blocks": 0, "dropout": 0.0, "warmup": 0, "cosine": False, "clip": 0.0, "ema": False}


def pretend() -> list[str]:
    """Make the device; the list that it returns is given the device of each loss that would be logged."""
    torch.utils.rename_privateuse1_backend(DEVICE)
    _setup_privateuseone_for_python_backend(DEVICE)
    torch.get_device_module(DEVICE).get_amp_supported_dtype = lambda: [torch.bfloat16]
    torch.random.fork_rng = nullcontext
    torch.nn.Module.to, torch.nn.Module.cpu = move, lambda module: move(module, "cpu")
    seeded = networks._seeded

    def made_of_numbers(*settings):
        with unset_fake_temporarily():
            return seeded(*settings)

    networks._seeded = made_of_numbers
    losses = []
    Training._log = lambda training, mean, plan: losses.append(mean.device.type)
    return losses


def move(module: torch.nn.Module, device: str) -> torch.nn.Module:
    """`Module.to`, which cannot exchange the contents of fake tensors: here parameters and buffers are new ones."""
    for part in module.modules():
        part._parameters |= {
            name: torch.nn.Parameter(p.detach().to(device)) for name, p in part._parameters.items() if p is not None
        }
        part._buffers |= {
            name: buffer.clone().to(device) for name, buffer in part._buffers.items() if buffer is not None
        }
    return module


def main() -> None:
    losses = pretend()
    with TemporaryDirectory() as folder, FakeTensorMode(allow_non_fake_inputs=True):
        for method in NETWORKS:
            train(method, steps=3, device=DEVICE)
        train("mlp", steps=3, device=DEVICE, settings=PLAIN)
        filmed = read_dataset(test_image.film(Path(folder)), name="filmed")
        test_image.train(test_image.lay(filmed), steps=3, device=DEVICE)
        assert losses == 3 * (len(NETWORKS) + 2) * [DEVICE], losses
        _Flow.velocity = lambda net, inputs, points, time: points + torch.zeros(len(points), 1)
        try:
            train("flow", steps=1, device=DEVICE)
        except FakeTensorDeviceMismatchError:
            print(f"no step of {len(NETWORKS) + 2} trainings mixes devices, and one that does is found")


if __name__ == "__main__":
    main()
