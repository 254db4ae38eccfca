"""Claims about the data of a trainer: the position is its whole state, and a plain replay buffer of clips will do."""

from __future__ import annotations

import zipfile

import pytest
import torch
from tiny import make_data, make_trainer, snapshot
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_ficreg import ActionBlocks
from torchrl_ficreg.trainers import find_checkpoint
from torchrl_ficreg.trainers.stream import ReplayStream


def plain_buffer(single_steps: bool = False, transform: ActionBlocks | None = None) -> ReplayBuffer:
    """The clips of the tiny dataset, or their frames one by one, in one of TorchRL's own buffers."""
    data = make_data()
    clips = data[torch.arange(len(data))]  # [N, T]
    buffer = ReplayBuffer(storage=LazyTensorStorage(2 * len(data)), batch_size=16, transform=transform)
    buffer.extend(clips.reshape(-1) if single_steps else clips)
    buffer.statistics = data.statistics
    return buffer


@pytest.mark.parametrize("transform", [None, ActionBlocks(2), ActionBlocks(2, num_frames=2)])
def test_a_buffer_of_single_steps_is_refused_whatever_makes_clips_of_them(transform):
    with pytest.raises(ValueError, match=r"stores single steps \[N\], expected clips .*: extend it with slices") as caught:
        make_trainer(data=plain_buffer(single_steps=True, transform=transform))
    assert "\n" not in str(caught.value)


def test_a_position_without_a_fingerprint_is_accepted():
    """Older checkpoints have none, nor have replay buffers of other kinds."""
    stream = ReplayStream(make_data(), torch.device("cpu"))
    next(iter(stream))
    state = stream.state_dict()
    assert state.pop("fingerprint") == stream.replay_buffer.fingerprint
    again = ReplayStream(make_data(), torch.device("cpu"))
    again.load_state_dict(state)
    assert again.replay_buffer.batches == 1
    plain = ReplayStream(plain_buffer(), torch.device("cpu"))
    plain.load_state_dict({**state, "fingerprint": "of something"})
    assert plain.state_dict() == {}


def test_a_plain_replay_buffer_of_clips_trains_validates_and_resumes(tmp_path):
    """Its data is not in the checkpoint."""
    settings = {"epochs": 2, "validate": False, "validation_buffer": plain_buffer()}
    trainer = make_trainer(tmp_path, data=plain_buffer(), **settings)
    trainer.train()
    assert (trainer.step, trainer.steps_per_epoch) == (18, 154 // 16)
    before = snapshot(tmp_path)
    assert b"validation" in before[tmp_path / "metrics.csv"]
    with zipfile.ZipFile(find_checkpoint(tmp_path)) as archive:
        assert sum(info.file_size for info in archive.infolist() if "-collector" in info.filename) < 1000
    again = make_trainer(tmp_path, data=plain_buffer(), **settings)
    assert again.resume() and again.step == 18
    again.train()
    assert snapshot(tmp_path) == before
