"""Settings of the trainer, one model per part. The presets are the pipeline's."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, Field, model_validator


class Strict(BaseModel, extra="forbid", allow_inf_nan=False, validate_assignment=True):
    """Unknown keys are errors; NaN and infinity are not numbers."""


class ModelSettings(Strict):
    """The deferred neural renderer (paper section III-D; DNR, Thies et al. 2019, section 4)."""

    texture_size: int = Field(default=512, ge=8, le=8192, description="texels per side of the finest texture level")
    texture_levels: int = Field(default=4, ge=1, le=12, description="levels of the texture pyramid, summed")
    texture_channels: int = Field(default=16, ge=12, le=256, description="channels; 9 of them meet the harmonics")
    spherical_harmonics: bool = Field(
        default=True, description="multiply 9 channels by bands 0-2 of the view direction"
    )
    aggregator: Literal["concat", "residual", "early", "none"] = Field(
        default="concat",
        description="concat: the paper's; residual: fused as a residual on the UV texture; early: 9-channel input;"
        " none: no neural texture",
    )
    modalities: Literal["uv", "uv+depth", "uv+normal", "uv+depth+normal"] = "uv+depth+normal"
    width: int = Field(default=64, ge=4, le=512, description="channels of the U-Net's first level")
    depth: int = Field(default=4, ge=1, le=6, description="down-samplings of the U-Net")
    base: Literal["none", "raster", "baked", "direct", "path"] = Field(
        default="none",
        description="image that the network corrects; raster: rasterised colour, baked: baked light and specular"
        " paths, path: a few path-traced samples, denoised",
    )
    guides: bool | Literal["camera"] = Field(
        default=False,
        description="view and reflection direction, normal, albedo and specular part as network inputs; camera: the"
        " normal in camera space instead of world-space directions, coverage, rays per pixel and their noise",
    )
    chain: bool = Field(default=False, description="look the UV texture up at the end of the specular path, too")
    stride: Literal[1, 2] = Field(default=1, description="2: U-Net at half resolution between full-resolution layers")
    network: Literal["unet", "mlp"] = Field(default="unet", description="mlp: pixels by themselves, 4 width channels")
    filter: Literal[0, 3] = Field(
        default=0, description="side of the per-pixel kernels that smooth the base image; 0 = none"
    )
    output: Literal["display", "log"] = Field(
        default="display", description="space in which the network corrects the base; log keeps highlights"
    )
    trust: float = Field(
        default=1.0, ge=0, le=1, description="share of the correction that is applied; 0 leaves the base image"
    )

    @model_validator(mode="after")
    def _fits(self) -> ModelSettings:
        if self.chain and self.base not in ("baked", "direct", "path"):
            raise ValueError(
                f"chain = true needs the specular path, which base = {self.base} has not;"
                " type --set model.chain=false, or --set model.base=baked"
            )
        if self.chain and self.aggregator in ("early", "none"):
            raise ValueError(
                f"chain = true needs a neural texture, which aggregator = {self.aggregator} has not;"
                " type --set model.chain=false, or --set model.aggregator=residual"
            )
        if self.aggregator == "none" and self.base == "none":
            raise ValueError(
                "aggregator = none works on a base image, and base = none gives none;"
                " type --set model.aggregator=concat, or --set model.base=baked"
            )
        if self.base == "none" and self.output == "log":
            raise ValueError(
                "output = log works on a base image, and base = none gives none;"
                " type --set model.output=display, or --set model.base=baked"
            )
        if self.base == "none" and self.trust != 1:
            raise ValueError(
                f"trust = {self.trust:g} mixes with a base image, and base = none gives none;"
                " type --set model.trust=1, or --set model.base=baked"
            )
        if self.base == "none" and self.filter:
            raise ValueError(
                f"filter = {self.filter} works on a base image, and base = none gives none;"
                " type --set model.filter=0, or --set model.base=baked"
            )
        if self.guides == "camera" and self.base not in ("baked", "direct", "path"):
            raise ValueError(
                f"guides = camera needs the noise of a base image, which base = {self.base} has not;"
                " type --set model.guides=true, or --set model.base=baked"
            )
        return self

    def coarse(self) -> ModelSettings:
        """The model of step 1. It sees rasterised images only, so it has no base image and no part that needs one."""
        fresh = ModelSettings()
        parts = ("base", "guides", "chain", "filter", "output", "trust")
        return self.model_copy(update={name: getattr(fresh, name) for name in parts})

    def unlike_corrector(self) -> str:
        """ "" or how a network of these settings differs from the shipped corrector, and what to type."""
        for name in ("base", "guides", "output", "filter", "network", "stride", "width", "depth"):
            own, wanted = getattr(self, name), getattr(CORRECTOR, name)
            if own != wanted:
                return (
                    f"the shipped corrector has {name} = {wanted}, model.{name} is {own};"
                    f" type --set model.{name}={wanted}, or --set finetune.step2.start=fresh"
                )
        return ""


CORRECTOR = ModelSettings(
    aggregator="none",
    modalities="uv",
    width=24,
    depth=3,
    base="baked",
    guides="camera",
    filter=3,
    stride=2,
    output="log",
)
"""The network of the shipped corrector (`dnrtrain.shipped`)."""


class Step1Settings(Strict):
    """Step 1: coarse DNR and selector on rasterised images (paper equations 2-5)."""

    epochs: int = Field(default=50, ge=1, description="one epoch is as many steps as there are candidate views")
    learning_rate: float = Field(default=1e-3, gt=0)
    learning_rate_end: float = Field(default=1e-4, gt=0)
    texture_rate_scale: float = Field(
        default=1.0, gt=0, description="learning rate of the UV texture's texels over the networks'"
    )
    weight_rl: float = Field(default=0.1, ge=0, description="lambda_RL")
    weight_dnr: float = Field(default=1.0, ge=0, description="lambda_DNRc")
    gamma: float = Field(default=0.5, ge=0, le=1, description="discount factor")
    epsilon_start: float = Field(default=0.9, ge=0, le=1)
    epsilon_end: float = Field(default=0.05, ge=0, le=1)
    reward: Literal["neg-loss", "pos-loss", "improvement", "improvement-own", "improvement-all"] = Field(
        default="neg-loss",
        description="of taking a view: -loss, +loss, or the loss's decrease on probe views, the view, all candidates",
    )
    reward_scale: Literal["relative", "raw"] = Field(
        default="raw", description="raw: the paper's; relative: loss rewards over the running mean loss"
    )
    q_target: Literal["double", "plain"] = Field(
        default="plain", description="plain: equation 3; double: double Q-learning, averaged target network"
    )
    embedding: int = Field(default=64, ge=4, description="width of camera embedding and hidden vector")
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        default="auto", description="auto: bfloat16 where it is fast"
    )
    validation_views: int = Field(default=8, ge=0, description="validation views rendered after each epoch")


class LossWeights(Strict):
    """The six losses of step 2 (paper, implementation details)."""

    photometric: float = Field(default=1.0, ge=0)
    ssim: float = Field(default=0.1, ge=0)
    perceptual: float = Field(default=0.1, ge=0)
    frequency: float = Field(default=0.01, ge=0)
    total_variation: float = Field(default=0.001, ge=0)
    regularisation: float = Field(default=0.1, ge=0)


class Step2Settings(Strict):
    """Step 2: fine-tuning on the selected ray-traced views."""

    epochs: int = Field(default=100, ge=1, description="passes over the selected views")
    batch: int = Field(default=1, ge=1, description="views per optimiser step")
    learning_rate: float = Field(default=1e-3, gt=0)
    learning_rate_end: float = Field(default=1e-4, gt=0)
    texture_rate_scale: float = Field(
        default=1.0, gt=0, description="learning rate of the UV texture's texels over the networks'"
    )
    photometric: Literal["l1", "mse"] = "l1"
    start: Literal["coarse", "fresh", "pretrained"] = Field(
        default="coarse",
        description="coarse: the weights of step 1, as far as they fit; fresh: new ones; pretrained: the shipped"
        " corrector's, and a neural texture that starts at zero",
    )
    ema: float = Field(
        default=0.0, ge=0, lt=1, description="decay per step of the averaged weights that become the model; 0 = off"
    )
    patch: int = Field(default=0, ge=0, description="side of the random square to train on; 0 = whole image")
    augment: bool = Field(default=True, description="random flips and quarter turns")
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        default="auto", description="auto: bfloat16 where it is fast"
    )
    validation_views: int = Field(default=8, ge=0, description="validation views rendered after each epoch")
    perceptual_crop: int = Field(
        default=0, ge=0, description="side of the random square that L_p looks at in each step; 0 = whole image"
    )
    perceptual_weights: Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=1, max_length=5)] = Field(
        default=(1 / 32, 1 / 16, 1 / 8, 1 / 4),
        description="w_j of L_p, from VGG16's relu1_2 on: as many as are named of relu2_2, relu3_3, relu4_3, relu5_3",
    )
    frequency_norm: Literal["backward", "ortho"] = Field(
        default="backward",
        description="of the FFT in L_FR; backward: none, so that L_FR counts the more the larger the picture",
    )
    loss: LossWeights = LossWeights()
