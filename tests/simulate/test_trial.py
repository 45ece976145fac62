"""Roll-outs as files: what is read is what was written."""

from dataclasses import fields

import numpy as np
import pytest

from pipeline.simulate.trial import load_rollouts, save_rollouts
from pipeline.types import Execution, Rollouts


def rolled(**changes) -> Rollouts:
    values = {
        "simulator": "pusht", "simulator_version": "1", "policy": "mlp_k01", "observations": "pose",
        "start_states": np.arange(3), "success": np.array([True, False, False]), "best_reward": np.array([1, 0.5, 0.25]),
        "best_coverage": np.array([0.96, 0.4, 0.2]), "steps": np.array([9, 20, 20]), "paths": np.zeros((3, 5, 2), np.float32),
    } | changes  # fmt: skip
    return Rollouts(**values)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {
            "execution": Execution(1, ensemble=True, delay=1), "interventions": np.array([0, 3, 1]),
            "corrections": np.array([0, 0.5, 0.02]), "stopped": np.array([0, 0, 1]),
        },
        {
            "simulator": "so101", "best_coverage": np.full(3, np.nan), "paths": None, "stage_names": ("near", "done"),
            "stages": np.array([[True, True], [True, False], [False, False]]),
        },
    ],
    ids=["in the plane", "as an ensemble, guarded", "with stages"],
)  # fmt: skip
def test_written_and_read_again(tmp_path, changes):
    written = [rolled(seed=seed, **changes) for seed in (0, 2, 10)]
    save_rollouts(written, tmp_path)
    assert {place.name for place in tmp_path.iterdir()} == {"seed_0", "seed_2", "seed_10"}
    for read, one in zip(load_rollouts(tmp_path), written, strict=True):
        for f in fields(Rollouts):
            np.testing.assert_array_equal(getattr(read, f.name), getattr(one, f.name), err_msg=f.name)
        assert read.stage_counts == one.stage_counts


def test_a_simulator_without_stages_writes_nothing_of_them(tmp_path):
    save_rollouts([rolled()], tmp_path)
    assert "stage" not in (tmp_path / "seed_0/rollouts.json").read_text()
