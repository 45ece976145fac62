"""The methods there are: from a name to where a method lives and what a benchmark must know of it; likewise the derived
features, symmetries and goals that policies can be given by name.

What belongs here: what may be asked about a method without importing torch. What does not: the methods (`policies`), what each is
made with (`settings`).

A name is one of this project's (`mlp`), `path/to/file.py:Class` or `package.module:Class` for a class of the user's own, or
`external` for predictions that were made elsewhere (`pipeline.external`).
"""

import re
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal


@dataclass(frozen=True)
class Method:
    """Where a method lives and what a benchmark must know before building it.

    chunk              "set": the config names chunk sizes, one policy each; "one": always a single action; "none": it
                       can be asked for any horizon and is scored on all
    trained            it has seeds and training steps
    rolled_out         it is rolled out where there is a simulator; None: if it is trained
    uses_observations  its answer depends on the observation set; else it runs once a data set
    frames             frames of `observation.state` that a method without an observation set looks at
    recipe             which windows it is made for (`windows.Recipe`)
    takes              what it can be given by the configuration (`TRANSFORM`, `BUDGET`, `NETWORK`, "history")
    camera             it looks at a camera, beside the observation set
    address            of a class of the user's own, which `cls` then finds
    """

    module: str
    cls: str
    chunk: Literal["set", "one", "none"] = "none"
    trained: bool = False
    rolled_out: bool | None = None
    uses_observations: bool = True
    frames: int = 0
    recipe: Literal["arm", "every_frame"] = "arm"
    takes: frozenset[str] = frozenset()
    camera: bool = False
    address: str | None = None

    def load_class(self) -> Any:
        """What has the method's `fit` and `restore`."""
        found = getattr(import_module(self.module), self.cls)
        return found if self.address is None else found(self.address)


TRANSFORM = frozenset({"history", "actions", "features", "symmetry", "hindsight"})
"""What concerns only what a policy sees and answers, and what it is shown."""
BUDGET = frozenset({"steps", "cpu_seconds"})
NETWORK = TRANSFORM | BUDGET | {"noise", "offset"}
HISTORY = frozenset({"history"})

EXTERNAL = "external"
"""The method of predictions made elsewhere: nothing here can train it or ask it."""

_OWN = re.compile(r"(?P<module>[^:]+):(?P<cls>[A-Za-z_]\w*)")


class Methods(dict[str, Method]):
    """This project's methods by name, and on asking for one by `where:Class` the adapter of a user's own.

    `in` asks what can be trained and asked here; EXTERNAL is not, though a row of that method can be looked up.
    """

    def __missing__(self, name: str) -> Method:
        if name == EXTERNAL:
            return Method("pipeline.external", "", chunk="set", trained=True, rolled_out=False)
        if is_own(name):
            return Method("pipeline.policies.own", "OwnMethod", chunk="set", trained=True, takes=HISTORY, address=name)
        raise KeyError(name)

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or (isinstance(name, str) and is_own(name))


def is_own(name: str) -> bool:
    """Whether a method's name is the address of a user's own class."""
    return _OWN.fullmatch(name) is not None


METHODS = Methods(
    {
        "hold_still": Method(
            "pipeline.policies.hold_still", "HoldStill", rolled_out=True, uses_observations=False, frames=1
        ),
        "mean_action": Method("pipeline.policies.mean_action", "MeanAction", uses_observations=False),
        "constant_velocity": Method(
            "pipeline.policies.constant_velocity", "ConstantVelocity", uses_observations=False, frames=2
        ),
        "nearest_neighbour": Method("pipeline.policies.nearest_neighbour", "NearestNeighbour", takes=HISTORY),
        "mlp": Method("pipeline.policies.mlp", "Mlp", chunk="set", trained=True, takes=NETWORK),
        "gmm": Method("pipeline.policies.gmm", "Gmm", chunk="set", trained=True, takes=NETWORK),
        "lwr": Method("pipeline.policies.lwr", "Lwr", chunk="set", trained=True, takes=TRANSFORM),
        "flow": Method("pipeline.policies.flow", "Flow", chunk="set", trained=True, takes=NETWORK),
        "diffusion": Method("pipeline.policies.diffusion", "Diffusion", chunk="set", trained=True, takes=NETWORK),
        "act": Method("pipeline.policies.act", "Act", chunk="set", trained=True, takes=NETWORK),
        "image": Method(
            "pipeline.policies.image",
            "Image",
            chunk="set",
            trained=True,
            takes=NETWORK - {"symmetry", "hindsight"},
            camera=True,
        ),
        "notebook_pusht": Method(
            "pipeline.policies.notebook_pusht", "NotebookPushT", chunk="one", trained=True, recipe="every_frame"
        ),
    }
)

DERIVED = {
    "pusht_block_frame": ("pipeline.policies.pusht_views", "block_frame"),
    "so101_hand_frame": ("pipeline.policies.so101_views", "hand_frame"),
}
"""Functions that derive features from what is seen: name → module and function (`policies.transform` says what they get)."""

SYMMETRIES = {
    "pusht_mirror": ("pipeline.policies.pusht_views", "mirror"),
    "so101_pan": ("pipeline.policies.so101_views", "turn"),
}
"""A data set's own symmetries, likewise."""

HINDSIGHT = {"pusht_goal": ("pipeline.policies.pusht_views", "end_at_goal")}
"""How episodes are told as if they had ended where they should, likewise."""
