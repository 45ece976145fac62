"""A trained policy as an MLflow model: `mlflow.pyfunc.load_model("runs:/<run>/model").predict([{"values": …}])`.

MLflow runs this file to get the model, so that nothing is pickled: the weights are a safetensors artefact.
"""

from pathlib import Path
from typing import Any

import mlflow
import numpy as np
from pydantic import BaseModel


class Observation(BaseModel):
    """One question to a policy, raw units: see `pipeline.types.Observations`, less the batch.

    values           [T, O] the observation set's columns, oldest frame first
    state            [T, P] `observation.state`; the policies that need it say so when it is missing
    previous_action  [A] the action one frame before
    """

    values: list[list[float]]
    state: list[list[float]] = []
    previous_action: list[float] = []


class PolicyModel(mlflow.pyfunc.PythonModel):
    """Answers each observation with a chunk of actions [K, A] in raw units, of the first seed."""

    def load_context(self, context: Any) -> None:
        from pipeline.train import load_trained

        self.policy = load_trained(Path(context.artifacts["policy"])).policy

    def predict(self, context, model_input: list[Observation]) -> list[list[list[float]]]:
        from pipeline.types import Observations

        values = np.array([one.values for one in model_input], np.float32)
        state = np.array([one.state or np.empty((len(one.values), 0)) for one in model_input], np.float32)
        previous = np.array([one.previous_action for one in model_input], np.float32)
        return self.policy.predict(Observations(values, state, previous))[0].tolist()


mlflow.models.set_model(PolicyModel())
