"""What each method is made with: one frozen, checked type a method, and the types' explicit dictionary.

What belongs here: names, defaults and limits of the settings of methods. What does not: what they do (each method's file),
and what every policy can be given, whatever its method (`config.PolicyConfig`).
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pipeline.errors import ConfigError, did_you_mean

Count = Annotated[int, Field(ge=1, le=100_000)]
Share = Annotated[float, Field(ge=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class MethodSettings(BaseModel):
    """Base of all: frozen; an unknown name, a number that is not finite and a number in quotes are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class TrainingSettings(MethodSettings):
    """How a network is trained: AdamW, gradients clipped, rates that rise at first and fall to the end.

    warmup   steps over which the rate rises          cosine  whether it then falls to zero as a cosine
    clip     the largest norm of a network's gradient, 0 for none
    ema      answer with a moving average of the weights, min(0.999, (1 + n)/(10 + n))
    bf16     multiply in bfloat16 (worth it on processors and GPUs that have it)
    """

    learning_rate: Positive = 1e-3
    weight_decay: NotNegative = 1e-4
    batch: Count = 256
    warmup: Annotated[int, Field(ge=0)] = 300
    cosine: bool = True
    clip: NotNegative = 1.0
    ema: bool = True
    bf16: bool = False


class ResidualSettings(TrainingSettings):
    """`blocks` residual blocks of `width`; 0 blocks are two hidden layers with ReLU."""

    width: Count = 512
    blocks: Annotated[int, Field(ge=0, le=100)] = 4
    dropout: Share = 0.0


class MlpSettings(ResidualSettings):
    """Left alone it is the plain network: two hidden layers, a constant rate, no average."""

    loss: Literal["l1", "squared", "huber"] = "l1"
    blocks: Annotated[int, Field(ge=0, le=100)] = 0
    warmup: Annotated[int, Field(ge=0)] = 0
    cosine: bool = False
    clip: NotNegative = 0.0
    ema: bool = False

    @property
    def is_plain(self) -> bool:
        """Whether the batched stack trains it: all seeds in one product, nothing that only single networks have."""
        asked = self.blocks or self.dropout or self.warmup or self.cosine or self.clip or self.ema or self.bf16
        return not asked


class GmmSettings(ResidualSettings):
    """`components` Gaussians over the whole chunk."""

    components: Annotated[int, Field(ge=1, le=100)] = 5
    learning_rate: Positive = 3e-4


class FlowSettings(ResidualSettings):
    """`start_noise` scales the noise that an answer starts from: 1 draws, 0 starts in the middle and draws nothing."""

    euler_steps: Annotated[int, Field(ge=1, le=1000)] = 10
    start_noise: NotNegative = 1.0


class DiffusionSettings(ResidualSettings):
    """`noise_steps` of the process that is learned, `sampling_steps` of them when an answer is drawn."""

    noise_steps: Annotated[int, Field(ge=2, le=10_000)] = 100
    sampling_steps: Annotated[int, Field(ge=1, le=10_000)] = 10

    @model_validator(mode="after")
    def _no_more_than_there_are(self) -> Self:
        if self.sampling_steps > self.noise_steps:
            raise ConfigError(
                f"sampling_steps is {self.sampling_steps}, and there are only {self.noise_steps} noise_steps to sample from."
            )
        return self


class ActSettings(TrainingSettings):
    """A transformer of `width` with `heads`, `layers` in each of its three parts, a latent of `latent` numbers.

    kl  the weight of the latent's divergence from its prior
    """

    width: Count = 128
    heads: Annotated[int, Field(ge=1, le=64)] = 4
    layers: Annotated[int, Field(ge=1, le=32)] = 2
    latent: Annotated[int, Field(ge=1, le=1024)] = 32
    kl: NotNegative = 10.0
    dropout: Share = 0.1
    batch: Count = 64
    learning_rate: Positive = 3e-4

    @model_validator(mode="after")
    def _heads_share_the_width(self) -> Self:
        if self.width % self.heads or self.width % 2:
            raise ConfigError(f"width is {self.width}: it must be even and a multiple of heads = {self.heads}.")
        return self


class ImageSettings(ResidualSettings):
    """`camera` is the data set's only one if it is not named; pictures are shrunk to squares of `pixels`."""

    camera: str | None = None
    pixels: Annotated[int, Field(ge=16, le=256)] = 48
    loss: Literal["l1", "squared", "huber"] = "l1"
    width: Count = 256
    blocks: Annotated[int, Field(ge=0, le=100)] = 2
    batch: Count = 64


class LwrSettings(MethodSettings):
    """How many `neighbours` reach how far, and how strongly slopes are held back (`ridge`); 0: chosen on training episodes."""

    neighbours: Annotated[int, Field(ge=0, le=100_000)] = 0
    ridge: NotNegative = 0.0


SETTINGS: dict[str, type[MethodSettings]] = {
    "mlp": MlpSettings,
    "gmm": GmmSettings,
    "lwr": LwrSettings,
    "flow": FlowSettings,
    "diffusion": DiffusionSettings,
    "act": ActSettings,
    "image": ImageSettings,
}


def settings_of(method: str, given: Mapping[str, Any]) -> MethodSettings:
    """The settings of one of the methods above, with defaults for what is not given.

    Raises:
        ConfigError: an unknown name ("did you mean"), or a value out of range.
    """
    kind = SETTINGS[method]
    try:
        return kind.model_validate(dict(given))
    except ValidationError as error:
        problem = error.errors()[0]
        name = ".".join(str(part) for part in problem["loc"])
        if problem["type"] == "extra_forbidden":
            raise ConfigError(
                f"the method '{method}' has no setting '{name}'. {did_you_mean(name, kind.model_fields)}"
            ) from None
        raise ConfigError(f"settings.{name}: {problem['msg']} (got {problem['input']!r}).") from None
