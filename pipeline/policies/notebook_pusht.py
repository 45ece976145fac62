"""The network that the notebook trained on PushT: it sees one frame and answers one action.

What belongs here: its sizes and rates. Everything else is the plain MLP's. Its windows are laid by the recipe `every_frame`.
"""

from typing import ClassVar

from pipeline.policies.fitting import Recipe
from pipeline.policies.mlp import PlainMlp


class NotebookPushT(PlainMlp):
    """Two hidden layers of 256 with ReLU, squared error, AdamW with the weight decay that PyTorch defaults to."""

    RECIPE: ClassVar[Recipe] = Recipe(
        hidden=(256, 256), loss="squared", batch=512, learning_rate=1e-3, weight_decay=0.01
    )
