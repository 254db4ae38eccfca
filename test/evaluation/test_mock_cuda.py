"""Claims about devices, shown by a mock where there is no GPU: planning and losses never mix CPU and CUDA tensors."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch
from _losses import make_clip, make_loss
from mock_cuda import CUDA, MixedDevices, MockCuda, to_cuda
from scenes import same_room_pairs

from torchrl_ficreg import GoalPolicy, MPCPolicy
from torchrl_ficreg.evaluation import evaluate_mpc
from torchrl_ficreg.planners import base as common, SEARCHES


def test_the_mocked_device_refuses_what_cuda_refuses():
    with MockCuda():
        here, there = torch.ones(2), torch.ones(2).to("cuda")
        assert there.device == CUDA and (there * 2).device == CUDA and here.device.type == "cpu"
        assert (there.cpu() + here).device.type == "cpu" and torch.zeros(2, device=CUDA).device == CUDA
        for mixed in (lambda: here + there, lambda: there.numpy(), lambda: here[there.long()], lambda: torch.cat([here, there])):
            with pytest.raises(MixedDevices):
                mixed()


@pytest.mark.parametrize("history", ["context", "one_frame"])
@pytest.mark.parametrize("search", SEARCHES)
def test_a_model_on_cuda_plans_for_environments_on_the_cpu(monkeypatch, tiny_world, search, history):
    """Three plans of an episode, the later ones with a past and a plan to continue; the outcome is that of the CPU."""
    model = tiny_world()
    policy = GoalPolicy(latent_dim=6, action_dim=4) if search == "policy" else None
    kind = SEARCHES[search].config_class
    settings = {"num_candidates": 8, "num_elites": 4, "iterations": 2, "horizon": 2, "receding_horizon": 1}
    known = {field.name for field in fields(kind)} & settings.keys()
    config = kind(**{name: settings[name] for name in known}, history=history, precision="fp32")
    planner = SEARCHES[search](model, config, action_bounds=([-1, -1], [1, 1]), policy=policy)

    def outcome():
        return evaluate_mpc(MPCPolicy(planner), same_room_pairs(3), budget=6, image_size=16, num_envs=2, progress_bar=False)

    expected = outcome()
    make = common.make_generator  # of a device that is not there none can be made
    monkeypatch.setattr(common, "make_generator", lambda seed, environment, device: make(seed, environment, torch.device("cpu")))
    with MockCuda():
        to_cuda(planner)
        found = outcome()
    assert torch.tensor(found.success).equal(torch.tensor(expected.success))


def test_a_loss_on_cuda_computes_on_cuda():
    loss, clip = make_loss("diagnostics"), make_clip()
    with MockCuda():
        to_cuda(loss)
        output = loss(pixels=clip["pixels"].to("cuda"), action=clip["action"].to("cuda"))
        for value in output if isinstance(output, tuple) else output.values():
            assert value.device == CUDA
