"""Time of every loss, eager and compiled; `make slow` runs it. Needs pytest-benchmark."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_ficreg import FICRegLoss, LeWMLoss, make_world_model, ModelConfig
from torchrl_ficreg.objectives import JointInverseLoss, PLDMLoss

pytest.importorskip("pytest_benchmark")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::FutureWarning:tensordict.*")]

LOSSES = {
    "lewm": (LeWMLoss, {}),
    "ficreg": (FICRegLoss, {}),
    "ficreg-live": (FICRegLoss, {"context": "live"}),
    "ficreg-trusted": (FICRegLoss, {"consistency": "trusted", "consistency_target": "judge"}),
    "joint": (JointInverseLoss, {}),
    "pldm": (PLDMLoss, {}),
}
SHAPES = {"cpu": (128, 2, 64), "paper": (8, 4, 224)}  # clips, frames, pixels


@pytest.mark.parametrize("mode", ["eager", "compiled"])
@pytest.mark.parametrize("preset", SHAPES)
@pytest.mark.parametrize("name", LOSSES)
def test_time_of_a_loss(benchmark, name, preset, mode):
    torch.manual_seed(0)
    batch, frames, size = SHAPES[preset]
    model, inverse_model = make_world_model(ModelConfig.preset(preset), action_dim=2)
    make, arguments = LOSSES[name]
    networks = (model.encoder, model.predictor) if make is LeWMLoss else (model.encoder, model.predictor, inverse_model)
    loss = make(*networks, **arguments)
    pixels = torch.randint(0, 256, (batch, frames, 3, size, size), dtype=torch.uint8)
    clip = TensorDict({"pixels": pixels, "action": torch.randn(batch, frames, 10)}, [batch, frames])
    torch._dynamo.reset()
    function = torch.compile(loss, fullgraph=True) if mode == "compiled" else loss

    def step() -> None:
        loss.zero_grad()
        sum(function(clip).values()).backward()

    benchmark.pedantic(step, rounds=3, warmup_rounds=1)
