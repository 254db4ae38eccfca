"""Files made by an earlier layout of the package, ``golden/first_layout.zip``, are read today.

A run directory of two epochs, the dataset it was trained on and a pretrained folder, with the numbers that the model gave.
test/sota/test_train_script.py continues and evaluates the run.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest
import torch

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.pretrained import load_pretrained, save_pretrained
from torchrl_ficreg.trainers import load_world_model

HERE = Path(__file__).parent
RUN, DATA = "runs/two_room_cpu_ficreg_seed0", "data/two_room_32px_20episodes_seed0"


@pytest.fixture(scope="module")
def golden(tmp_path_factory) -> Path:
    """The unpacked files, to be read only."""
    folder = tmp_path_factory.mktemp("golden")
    with zipfile.ZipFile(HERE / "golden" / "first_layout.zip") as archive:
        archive.extractall(folder)
    return folder


def close(found, expected):
    """Up to the rounding of float32, which differs between processors."""
    torch.testing.assert_close(found, torch.tensor(expected), rtol=1e-3, atol=1e-4)


def test_a_run_and_its_dataset_give_the_numbers_they_gave(golden):
    expected = json.loads((golden / "expected.json").read_text())
    data = OfflineTrajectories(golden / DATA, split="evaluation", num_frames=2, frame_skip=5, batch_size=2, shuffle=False)
    assert data.fingerprint == expected["fingerprint"]
    model, inverse_model, card = load_world_model(golden / RUN)
    assert card.env == "two_room" and card.action_dim == 2 and inverse_model is not None
    clip = data.sample()
    close(clip["action"], expected["action"])
    with torch.no_grad():
        latent = model.encoder.module(clip["pixels"])
        close(latent, expected["latent"])
        close(model.rollout(latent[:, :1], clip["action"][:, :1]), expected["rollout"])


def test_a_pretrained_folder_loads_and_is_written_again_to_the_bit(golden, tmp_path):
    pytest.importorskip("safetensors")
    model, inverse_model, card = load_pretrained(golden / "pretrained")
    trained, trained_inverse, _ = load_world_model(golden / RUN)
    for ours, theirs in ((model, trained), (inverse_model, trained_inverse)):
        state = theirs.state_dict()
        assert ours.state_dict().keys() == state.keys()
        assert all(value.equal(state[name]) for name, value in ours.state_dict().items())
    save_pretrained(model, tmp_path, inverse_model, card)
    for name in ("config.json", "model.safetensors"):
        assert (tmp_path / name).read_bytes() == (golden / "pretrained" / name).read_bytes()
