"""Claims about two ranks: they train as one process on the same global batches, and if one fails both stop."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from pathlib import Path

import pytest
import torch
import torch.distributed.run
from ranks import make_pldm, make_ranked, work, WORLD_SIZE
from tiny import logged_steps, make_data, make_trainer, same, STILL, table, weights

from torchrl_ficreg.distributed import (
    all_reduce_mean,
    any_rank,
    broadcast_from_rank0,
    is_main,
    process_group,
    world_size,
)
from torchrl_ficreg.trainers.stepper import check_batch_size

# BatchNorm removes a shift of its input, so the gradient of these is rounding noise, of which Adam makes whole steps. No
# output depends on them, but in eval mode the running mean lags a little behind.
SHIFTS = ("projector.layer_in.bias", "predictor_params.module.norm.bias", "projector.norm.running_mean")


@pytest.fixture(scope="module")
def ranks(tmp_path_factory) -> tuple[Path, list[dict]]:
    """The folder of all runs on two ranks, and what each rank found."""
    folder = tmp_path_factory.mktemp("ranks")
    context = multiprocessing.get_context("forkserver")
    processes = [context.Process(target=work, args=(rank, folder)) for rank in range(WORLD_SIZE)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(300)
    assert [process.exitcode for process in processes] == [0] * WORLD_SIZE
    return folder, [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(WORLD_SIZE)]


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """One process on the whole batches: its folder and its trainers, by method."""
    folder = tmp_path_factory.mktemp("single")
    trainers = {"ficreg": make_ranked(folder / "ficreg", 0, 1, sizes=STILL), "pldm": make_pldm(folder / "pldm", 0, 1)}
    for trainer in trainers.values():
        trainer.train()
    return folder, trainers


def numbers(run_dir: Path, split: str) -> list[dict[str, float]]:
    return [{key: float(value) for key, value in row.items() if key != "split" and value} for row in table(run_dir, split)]


def distance(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> float:
    """Largest difference of two states, without the shifts that BatchNorm removes."""
    assert first.keys() == second.keys()
    counted = [name for name in first if not name.endswith(SHIFTS)]
    assert len(first) - len(counted) == 5
    return max((first[name].double() - second[name].double()).abs().max().item() for name in counted)


@pytest.mark.parametrize("method", ["ficreg", "pldm"])
def test_the_weights_are_those_of_one_process(ranks, single, method):
    """Parameters and statistics within 1e-4 (here: 2e-6), bitwise the same on both ranks; PLDM has variances."""
    found = [rank[method] for rank in ranks[1]]
    assert same(*found)
    assert distance(weights(single[1][method]), found[0]) < 1e-4
    if method == "ficreg":
        assert distance(found[0], weights(make_trainer(sizes=STILL))) > 0.05


@pytest.mark.parametrize(
    ("method", "prefixes", "count"),
    [("ficreg", ("loss_", "grad_norm", "learning_rate"), 9), ("pldm", ("loss_", "floor_ratio", "effective_rank"), 8)],
)
def test_every_step_shows_the_numbers_of_the_global_batch(ranks, single, method, prefixes, count):
    """Loss terms, the norm of all gradients and of each network's, the learning rate, diagnostics; rank 0 alone writes."""
    ours, expected = numbers(ranks[0] / method, "train"), numbers(single[0] / method, "train")
    assert [row["step"] for row in ours] == list(range(1, 28 if method == "ficreg" else 10))
    names = [name for name in expected[0] if name.startswith(prefixes)]
    assert len(names) == count and ("loss_cov" in names) == (method == "pldm")
    for one, other in zip(ours, expected, strict=True):
        assert {name: one[name] for name in names} == pytest.approx({name: other[name] for name in names}, rel=1e-3, abs=1e-4)


def test_held_out_clips_are_split_too(ranks, single):
    ours, expected = numbers(ranks[0] / "ficreg", "validation"), numbers(single[0] / "ficreg", "validation")
    assert [row["step"] for row in ours] == [9, 18, 27]
    for one, other in zip(ours, expected, strict=True):
        assert one == pytest.approx(other, abs=2e-2)  # see SHIFTS


def test_a_resumed_run_ends_with_bitwise_the_weights_of_an_unbroken_one(ranks):
    """Dropout included, which differs between ranks."""
    for rank in ranks[1]:
        assert rank["resumed at"] == 9
        assert same(rank["resumed"], rank["unbroken"])
    assert not torch.equal(*(rank["random state"] for rank in ranks[1]))


def test_a_run_may_be_continued_by_another_number_of_ranks(ranks, single):
    """Nine steps on two ranks, eighteen on one: the weights of one process."""
    moved = make_ranked(ranks[0] / "moved", 0, 1, sizes=STILL)
    assert moved.resume() and moved.step == 9
    moved.train()
    assert distance(weights(moved), weights(single[1]["ficreg"])) < 1e-4


def test_a_number_that_is_not_finite_on_one_rank_stops_both_at_the_same_step(ranks):
    first, second = (rank["not finite"] for rank in ranks[1])
    assert first == second
    assert first[0] == 4 and "step 4: not finite: loss_pred=nan" in first[1]


@pytest.mark.parametrize("ranks", [2, 4, 8])
@pytest.mark.parametrize("drop_last", [True, False])
def test_the_clips_of_all_ranks_are_the_batch(ranks, drop_last):
    """Two epochs: no clip twice, none left out but the rest of an epoch that cannot be split equally."""
    whole = make_data(drop_last=drop_last)
    parts = [make_data(drop_last=drop_last, rank=rank, world_size=ranks) for rank in range(ranks)]
    batches, clips = (9, 144) if drop_last or ranks == 8 else (10, 154 - 154 % ranks)  # eight leave one each: none
    assert all(part.batches_per_epoch == batches for part in parts)
    for _ in range(2):
        seen = []
        for batch in range(batches):
            expected = whole.sample()["index"][:, 0].tolist()
            shares = [part.sample() for part in parts]
            assert len({len(share) for share in shares}) == 1
            together = [index for share in shares for index in share["index"][:, 0].tolist()]
            assert together == expected[: len(together)]
            assert len(expected) - len(together) < (ranks if batch == 9 else 1)
            seen += together
        assert len(seen) == len(set(seen))
        assert len(seen) == clips
        whole.seek(whole.batches_per_epoch)


def test_clips_of_a_rank_are_sought_and_prefetched_like_whole_batches():
    plain, ahead = make_data(rank=1, world_size=2), make_data(rank=1, world_size=2, prefetch=2)
    batches = [plain.sample() for _ in range(5)]
    assert all((one == ahead.sample()).all() for one in batches)
    again = make_data(rank=0, world_size=2)
    again.load_state_dict(plain.state_dict())  # a position means the same on every process
    assert again.batches == 5
    plain.seek(3)
    assert (plain.sample() == batches[3]).all()


def test_mistakes_are_named(monkeypatch):
    with pytest.raises(ValueError, match="3 processes cannot share a batch_size of 16: give a multiple of 3"):
        make_data(rank=0, world_size=3)
    with pytest.raises(ValueError, match="got rank=2 and world_size=2"):
        make_data(rank=2, world_size=2)
    with pytest.raises(ValueError, match="rank 0 of 1 was given a dataset of rank 0 of 2"):
        make_trainer(data=make_data(rank=0, world_size=2))
    for name, value in {"TORCHELASTIC_RUN_ID": "x", "WORLD_SIZE": "5", "RANK": "3", "LOCAL_RANK": "3"}.items():
        monkeypatch.setenv(name, value)
    assert not is_main()
    with pytest.raises(ValueError, match="batch_size=128 counts the clips of all 5 processes: give a multiple of 5"):
        check_batch_size(128)
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="3 of this machine has no CUDA device, there are 0"):
            with process_group(torch.device("cuda")):
                pass


def test_a_single_process_needs_no_process_group():
    value = torch.tensor(2.0, requires_grad=True)
    with process_group(torch.device("cpu")) as device:
        assert not torch.distributed.is_initialized()
        assert (device.type, world_size(), is_main()) == ("cpu", 1, True)
        assert all_reduce_mean({"loss": value})["loss"].equal(value.detach())
        assert any_rank(True) and not any_rank(False) and broadcast_from_rank0("x") == "x"


def launch(folder: Path, failing: int, output: Path) -> None:
    """What the command torchrun does, in a process that has imported torch."""
    for number, stream in enumerate((sys.stdout, sys.stderr), 1):
        stream.flush()
        os.dup2(os.open(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
    script = Path(__file__).with_name("ranks.py")
    os.environ |= {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(script.parents[2])}
    torch.distributed.run.main(["--standalone", "--nproc-per-node=2", str(script), str(folder), str(failing)])


def torchrun(folder: Path, failing: int) -> tuple[int, str, float]:
    """Runs ranks.py with two processes, of which one fails: exit code, output, seconds between failure and end."""
    output = folder.with_name("output")
    process = multiprocessing.get_context("forkserver").Process(target=launch, args=(folder, failing, output))
    process.start()
    process.join(240)
    metrics = folder / "run" / "metrics.csv"
    return process.exitcode, output.read_text(), time.time() - metrics.stat().st_mtime


@pytest.mark.parametrize("failing", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_all_ranks_stop_within_seconds_when_one_fails(tmp_path, failing):
    """The last row of the table is from the step of the failure."""
    (folder := tmp_path / "ranks").mkdir()
    code, said, seconds = torchrun(folder, failing)
    assert code not in (0, None)
    assert "OSError: injected" in said
    assert not [*folder.glob("* done")]
    assert logged_steps(folder / "run") == [1, 2, 3, 4, 5]
    assert seconds < 20  # on a busy machine; about one otherwise


def test_processes_that_torchrun_started_end_together(tmp_path):
    (folder := tmp_path / "ranks").mkdir()
    code, said, _ = torchrun(folder, failing=-1)
    assert code == 0, said
    assert {path.name for path in folder.iterdir()} == {"0 done", "1 done", "run"}
    assert {path.name for path in (folder / "run").iterdir()} == {"checkpoints", "metrics.csv"}
    assert make_ranked(folder / "run", 0, 1, sizes=STILL, epochs=1, validation_buffer=None).resume()
