"""A trained policy as an MLflow model: `mlflow.pyfunc.load_model("runs:/<run>/model").predict({"values": …})`.

MLflow runs this file to get the model, so that nothing is pickled: the weights are a safetensors artefact.
"""

from typing import Any

import mlflow
import numpy as np


class PolicyModel(mlflow.pyfunc.PythonModel):
    """Answers with chunks of actions in raw units.

    Input is a dict of arrays: `values` [B, T, O] (the observation set's columns, oldest frame first) and, where the policy
    uses them, `state` [B, T, P] and `previous_action` [B, A]. Output is [B, K, A], of the first seed.
    """

    def load_context(self, context: Any) -> None:
        from pathlib import Path

        from pipeline.train import load_trained

        self.policy = load_trained(Path(context.artifacts["policy"])).policy

    def predict(self, context: Any, model_input: dict[str, Any], params: Any = None) -> np.ndarray:
        from pipeline.types import Observations

        values = np.asarray(model_input["values"], np.float32)
        state = np.asarray(model_input.get("state", values[..., :0]), np.float32)
        previous = np.asarray(model_input.get("previous_action", np.full((len(values), 0), np.nan)), np.float32)
        return np.asarray(self.policy.predict(Observations(values, state, previous))[0])


mlflow.models.set_model(PolicyModel())
