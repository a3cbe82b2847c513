"""From fiducial positions to a rig: our own network, shared by the point and the image variants.

There is one token per camera and one for the rig, with attention over all of them. The first pass predicts the rig from
positions alone. Every later pass projects the object with the current rig and gets the residuals, so that a fraction of
a pixel becomes a number that the network can act on. All heads predict offsets from the factory rig and start at zero:
an untrained network returns the factory calibration.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from imgcal.networks.layers import conv1d, mlp, transformer, zero_last_layer
from imgcal.networks.parameterization import Parameterization, RigState
from imgcal.types import Prediction

RESIDUAL_SCALES = (20.0, 4.0)  # pixels at which a residual saturates; in addition to a linear part (in 100 px)
LIMIT = 5.0  # largest input of the linear parts
LEAST_TRUST = 7.0  # largest log of a factor on sigma: a thousand sigmas, practically no weight


class UpdateBlock(nn.Module):
    """One pass: from the inputs of each camera to parameters of each camera and of the pose."""

    def __init__(
        self,
        inputs: int,
        features: int,
        cameras: int,
        outputs: tuple[int, int],
        encoder: str,
        width: int,
        depth: int,
        heads: int,
    ) -> None:
        super().__init__()
        parameters, pose = outputs
        self.embed = mlp((inputs, 2 * width, width))
        self.embed_features = nn.Linear(features, width, bias=False) if features else None
        self.camera_identity = nn.Parameter(0.5 * torch.randn(cameras, width))
        self.rig_token = nn.Parameter(0.5 * torch.randn(width))
        self.encoder = transformer(width, depth, heads) if encoder == "transformer" else conv1d(width, depth)
        self.camera_head = zero_last_layer(mlp((width + inputs, 2 * width, parameters)))
        self.pose_head = zero_last_layer(mlp((width, 2 * width, pose)))

    def forward(self, inputs: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor]:
        """(B, C, inputs), (B, C, features) -> (B, C, K), (B, pose)."""
        tokens = self.embed(inputs) + self.camera_identity
        if self.embed_features is not None and features is not None:
            tokens = tokens + self.embed_features(features)
        tokens = torch.cat((tokens, self.rig_token.expand(tokens.shape[0], 1, -1)), dim=1)
        encoded = self.encoder(tokens)
        with torch.autocast(inputs.device.type, enabled=False):
            encoded = encoded.to(inputs.dtype)
            # The heads also get the inputs directly, because normalization would lose precision.
            return self.camera_head(torch.cat((encoded[:, :-1], inputs), dim=-1)), self.pose_head(encoded[:, -1])


class IterativeRefiner(nn.Module):
    """Predict rigs, coarse to fine, from positions and their weights."""

    def __init__(
        self,
        parameterization: Parameterization,
        *,
        encoder: str,
        width: int,
        heads: int,
        depth: int,
        later_depth: int,
        passes: int,
        trust: bool = False,
        features: int = 0,
    ) -> None:
        super().__init__()
        self.parameterization, self.passes = parameterization, passes
        cameras, fiducials = len(parameterization.focal_length), len(parameterization.centred)
        parameters = parameterization.num_parameters
        shape = (encoder, width, depth, heads)
        self.first = UpdateBlock(3 * fiducials, features, cameras, (parameters, 9), *shape)
        parts = 2 * (len(RESIDUAL_SCALES) + 2) + 1
        later = (encoder, width, later_depth, heads)
        inputs = parts * fiducials + parameters
        self.later = UpdateBlock(inputs, features, cameras, (parameters, 6), *later) if passes > 1 else None
        self.trust_head = zero_last_layer(mlp((inputs, width, fiducials))) if trust else None

    def forward(self, uv: Tensor, weight: Tensor, features: Tensor | None = None) -> tuple[Prediction, ...]:
        """Predict rigs in all passes.

        Args:
            uv: (B, C, N, 2) pixels of the sensor; any finite value where the weight is zero.
            weight: (B, C, N) in [0, 1], zero for missing fiducials.
            features: (B, C, F) of an image encoder, or None.

        Returns:
            One prediction per pass.
        """
        device = uv.device.type
        with torch.autocast(device, enabled=False):
            uv, weight = uv.float(), weight.float()
            positions = self.parameterization.normalize(uv).clamp(-LIMIT, LIMIT) * weight[..., None]
            inputs = torch.cat((positions.flatten(-2), weight), dim=-1)
        offsets, pose = self.first(inputs, features)
        with torch.autocast(device, enabled=False):
            state = self.parameterization.start(offsets, pose)
            predictions = [self.parameterization.prediction(state)]
        for _ in range(self.passes - 1):
            state = state.detach()  # each pass only learns from its own error, as in RAFT (Teed and Deng, ECCV 2020)
            with torch.autocast(device, enabled=False):
                inputs = self._differences(state, predictions[-1], uv, weight)
            assert self.later is not None
            offsets, pose = self.later(inputs, features)
            with torch.autocast(device, enabled=False):
                state = self.parameterization.move(state, offsets, pose)
                predictions.append(self.parameterization.prediction(state))
        if self.trust_head is not None:
            with torch.autocast(device, enabled=False):
                log_sigma = self.trust_head(self._differences(state.detach(), predictions[-1], uv, weight))
            predictions[-1] = replace(predictions[-1], log_sigma=log_sigma.clamp(-LEAST_TRUST, LEAST_TRUST))
        return tuple(predictions)

    @torch.no_grad()
    def rescale(self, prior_std: Tensor) -> None:
        """Convert weights that were trained with offsets in other units to the units of this network.

        Args:
            prior_std: (C', K') of the other training; its mean over cameras is used, so their number may differ. With
                another number of lens coefficients, the affected layers have another shape and were not copied, so
                nothing is converted.
        """
        if prior_std.shape[-1] != self.parameterization.num_parameters:
            return
        old, new = prior_std.to(self.parameterization.prior_std).mean(0), self.parameterization.prior_std.mean(0)
        ratio = torch.where((old > 0) & (new > 0), old / new.clamp_min(1e-30), 1.0)
        for stage in (self.first, self.later):
            if stage is not None:
                for parameter in stage.camera_head[-1].parameters():  # (K, width) and (K,)
                    parameter.mT.mul_(ratio) if parameter.ndim == 2 else parameter.mul_(ratio)
        # Offsets are also the last inputs of some layers.
        offset_layers = [] if self.later is None else [self.later.embed[0], self.later.camera_head[0]]
        for layer in [*offset_layers, *([] if self.trust_head is None else [self.trust_head[0]])]:
            next(layer.parameters())[:, -self.parameterization.num_parameters :] /= ratio

    def _differences(self, state: RigState, prediction: Prediction, uv: Tensor, weight: Tensor) -> Tensor:
        """Inputs of a later pass: (B, C, inputs). Gradients flow to the positions, not to the current rig."""
        with torch.no_grad():
            projected = self.parameterization.project(prediction).uv
        residual = (projected - uv) * weight[..., None]
        scaled = [torch.tanh(residual / scale) for scale in RESIDUAL_SCALES]
        around = self.parameterization.normalize(projected)
        parts = [(residual / 100).clamp(-LIMIT, LIMIT), *scaled, around.clamp(-LIMIT, LIMIT)]
        offsets = state.offsets.clamp(-LIMIT, LIMIT)
        return torch.cat((*(part.flatten(-2) for part in parts), weight, offsets), dim=-1)
