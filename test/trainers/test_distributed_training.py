"""Two processes train as one would on the same global batches, and none survives the other."""

from __future__ import annotations

import csv
import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from ranks import make_part, num_moments, STILL, STRATEGIES, work, WORLD
from tiny import make_data, make_trainer, same, weights

from torchrl_ficreg import make_world_model
from torchrl_ficreg.distributed import any_process, average, from_main, is_main, process_group, world_size
from torchrl_ficreg.objectives import PLDMLoss
from torchrl_ficreg.trainers import LatentAlarm, OfflineTrainer
from torchrl_ficreg.trainers.stepper import check_processes

# BatchNorm takes a shift of its input away again, so these have a gradient of rounding noise, and Adam makes whole steps
# of it. No output depends on them, but in eval mode the running mean lags a little behind.
SHIFTS = ("projector.layer_in.bias", "predictor_params.module.norm.bias", "projector.norm.running_mean")


def make_pldm(run_dir: Path, rank: int, world: int, strategy: str = "ddp") -> OfflineTrainer:
    """One epoch, with an alarm that looks at steps 1, 3, 6 and 9."""
    torch.manual_seed(0)
    model, inverse_model = make_world_model(STILL, action_dim=2)
    settings = {"epochs": 1, "lr": 1e-2, "log_interval": 1, "precision": "fp32", "progress_bar": False}
    loss, data = PLDMLoss(model.encoder, model.predictor, inverse_model, idm_coeff=1.0), make_data(part=(rank, world))
    trainer = OfflineTrainer(loss, data, run_dir=run_dir, strategy=strategy, **settings)
    LatentAlarm(3, "fp32", trainer.metrics_table).register(trainer)
    return trainer


def work_twice(rank: int, folder: Path) -> None:
    """What ranks.py says, then PLDM."""
    work(rank, folder)
    dist.init_process_group("gloo", init_method=f"file://{folder}/second meeting", rank=rank, world_size=WORLD)
    for strategy in STRATEGIES:
        trainer = make_pldm(folder / f"pldm {strategy}", rank, WORLD, strategy)
        trainer.train()
        torch.save(weights(trainer), folder / f"pldm {strategy} {rank}.pt")
    dist.barrier()
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def ranks(tmp_path_factory) -> tuple[Path, list[dict]]:
    """The folder of all runs on two processes, and what each process found."""
    folder = tmp_path_factory.mktemp("ranks")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torchrl_ficreg.trainers"])
    processes = [context.Process(target=work_twice, args=(rank, folder)) for rank in range(WORLD)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(300)
    assert [process.exitcode for process in processes] == [0] * WORLD
    return folder, [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(WORLD)]


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """One process on the whole batches: its folder and its trainer after 27 steps."""
    run_dir = tmp_path_factory.mktemp("single")
    trainer = make_part(run_dir, 0, 1, sizes=STILL)
    trainer.train()
    return run_dir, trainer


def rows(run_dir: Path, split: str) -> list[dict[str, float]]:
    with open(run_dir / "metrics.csv", newline="") as file:
        table = [row for row in csv.DictReader(file) if row.pop("split") == split]
    return [{key: float(value) for key, value in row.items() if value} for row in table]


def distance(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> float:
    """Largest difference of two states, shifts that BatchNorm takes away left out."""
    assert first.keys() == second.keys()
    counted = [name for name in first if not name.endswith(SHIFTS)]
    assert len(first) - len(counted) == 5
    return max((first[name].double() - second[name].double()).abs().max().item() for name in counted)


@pytest.mark.parametrize("run", STRATEGIES)
def test_the_weights_after_27_steps_are_those_of_one_process(ranks, single, run):
    """Parameters and statistics within 1e-4 (here: 2e-6), to the last bit the same on both processes."""
    found = [rank[run] for rank in ranks[1]]
    assert same(*found)
    start = weights(make_trainer(sizes=STILL))
    assert distance(weights(single[1]), start) > 0.05
    assert distance(weights(single[1]), found[0]) < 1e-4


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_step_shows_the_numbers_of_the_global_batch(ranks, single, strategy):
    """Loss terms, the norm of all gradients and of each network's, the learning rate; the main process alone writes."""
    ours, expected = rows(ranks[0] / strategy, "train"), rows(single[0], "train")
    assert [row["step"] for row in ours] == list(range(1, 28))
    names = [name for name in expected[0] if name.startswith(("loss_", "grad_norm", "learning_rate"))]
    assert len(names) == 9
    for one, other in zip(ours, expected, strict=True):
        assert {name: one[name] for name in names} == pytest.approx({name: other[name] for name in names}, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_variances_and_diagnostics_are_those_of_the_global_batch(ranks, tmp_path, strategy):
    """PLDM: weights within 1e-4 of one process, every loss term, and what the alarm finds on looking."""
    trainer = make_pldm(tmp_path, 0, 1)
    trainer.train()
    found = [torch.load(ranks[0] / f"pldm {strategy} {rank}.pt") for rank in range(WORLD)]
    assert same(*found)
    assert distance(weights(trainer), found[0]) < 1e-4
    ours, expected = rows(ranks[0] / f"pldm {strategy}", "train"), rows(tmp_path, "train")
    assert [row["step"] for row in ours] == list(range(1, 10))
    names = [name for name in expected[0] if name.startswith(("loss_", "floor_ratio", "effective_rank"))]
    assert len(names) == 8 and "loss_cov" in names
    for one, other in zip(ours, expected, strict=True):
        assert {name: one[name] for name in names} == pytest.approx({name: other[name] for name in names}, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_held_out_clips_are_shared_too(ranks, single, strategy):
    ours, expected = rows(ranks[0] / strategy, "validation"), rows(single[0], "validation")
    assert [row["step"] for row in ours] == [9, 18, 27]
    for one, other in zip(ours, expected, strict=True):
        assert one == pytest.approx(other, abs=2e-2)  # see SHIFTS


def test_fsdp_keeps_half_of_the_moments_on_each_process(ranks, single):
    """Apart from counters, and from rows that two processes cannot share equally."""
    whole = num_moments(single[1])
    assert [rank["ddp, moments"] for rank in ranks[1]] == [whole] * WORLD
    assert sum(rank["fsdp, moments"] for rank in ranks[1]) == pytest.approx(whole, rel=0.01)
    assert max(rank["fsdp, moments"] for rank in ranks[1]) < 0.53 * whole


def test_a_resumed_run_ends_with_the_very_weights_of_an_unbroken_one(ranks):
    """Dropout included, which is another on every process."""
    for rank in ranks[1]:
        assert rank["resumed at"] == 9
        assert same(rank["resumed"], rank["unbroken"])
    assert not torch.equal(*(rank["random state"] for rank in ranks[1]))


def test_a_run_may_be_continued_by_other_numbers_of_processes_and_strategies(ranks, single):
    """Nine steps of DDP, nine of FSDP, nine of one process: the weights of one process."""
    assert [rank["second life begins"] for rank in ranks[1]] == [9, 9]
    third = make_part(ranks[0] / "three", 0, 1, sizes=STILL)
    assert third.resume() and third.step == 18
    third.train()
    assert distance(weights(third), weights(single[1])) < 1e-4


def test_a_number_that_is_none_on_one_process_stops_both_at_the_same_step(ranks):
    first, second = (rank["not a number"] for rank in ranks[1])
    assert first == second
    assert first[0] == 4 and "step 4: not finite: loss_pred=nan" in first[1]


@pytest.mark.parametrize("pieces", [2, 4, 8])
@pytest.mark.parametrize("drop_last", [True, False])
def test_the_parts_of_every_batch_are_that_batch(pieces, drop_last):
    """Two epochs: no clip twice, none left out but the rest of an epoch that cannot be shared equally."""
    whole = make_data(drop_last=drop_last)
    parts = [make_data(drop_last=drop_last, part=(piece, pieces)) for piece in range(pieces)]
    batches, clips = (9, 144) if drop_last or pieces == 8 else (10, 154 - 154 % pieces)  # eight leave one each: none
    assert all(part.batches_per_epoch == batches for part in parts)
    for _ in range(2):
        seen = []
        for batch in range(batches):
            expected = whole.sample()["index"][:, 0].tolist()
            shares = [part.sample() for part in parts]
            assert len({len(share) for share in shares}) == 1
            together = [index for share in shares for index in share["index"][:, 0].tolist()]
            assert together == expected[: len(together)]
            assert len(expected) - len(together) < (pieces if batch == 9 else 1)
            seen += together
        assert len(seen) == len(set(seen))
        assert len(seen) == clips
        whole.seek(whole.batches_per_epoch)


def test_a_part_is_sought_and_prefetched_like_a_whole_batch():
    plain, ahead = make_data(part=(1, 2)), make_data(part=(1, 2), prefetch=2)
    batches = [plain.sample() for _ in range(5)]
    assert all((one == ahead.sample()).all() for one in batches)
    again = make_data(part=(0, 2))
    again.load_state_dict(plain.state_dict())  # a position means the same on every process
    assert again.batches == 5
    plain.seek(3)
    assert (plain.sample() == batches[3]).all()


def test_mistakes_are_put_into_words(monkeypatch, tmp_path):
    with pytest.raises(ValueError, match="3 processes cannot share a batch_size of 16: give a multiple of 3"):
        make_data(part=(0, 3))
    with pytest.raises(ValueError, match=r"part is \(r, n\) with 0 <= r < n, got \(2, 2\)"):
        make_data(part=(2, 2))
    with pytest.raises(ValueError, match=r"process 0 of 1 was given a dataset with part=\(0, 2\)"):
        make_trainer(data=make_data(part=(0, 2)))
    with pytest.raises(ValueError, match="unknown distributed.strategy 'zero'"):
        make_trainer(strategy="zero")
    for name, value in {"TORCHELASTIC_RUN_ID": "x", "WORLD_SIZE": "5", "RANK": "3", "LOCAL_RANK": "3"}.items():
        monkeypatch.setenv(name, value)
    assert not is_main()
    with pytest.raises(ValueError, match="batch_size=128 counts the clips of all 5 processes: give a multiple of 5"):
        check_processes("ddp", 128)
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="process 3 of this machine has no CUDA device, there are 0"):
            with process_group(torch.device("cuda")):
                pass


def test_a_process_on_its_own_meets_nobody():
    value = torch.tensor(2.0, requires_grad=True)
    with process_group(torch.device("cpu")) as device:
        assert not torch.distributed.is_initialized()
        assert (device.type, world_size(), is_main()) == ("cpu", 1, True)
        assert average({"loss": value})["loss"].equal(value.detach())
        assert any_process(True) and not any_process(False) and from_main("x") == "x"


def torchrun(folder: Path, failing: int) -> tuple[subprocess.CompletedProcess, float]:
    """Two processes of ranks.py, of which one fails; and the seconds between its failure and the end of the command."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    script = Path(__file__).with_name("ranks.py")
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(script.parents[2])}
    done = subprocess.run(
        [*command, str(script), str(folder), str(failing)], env=environment, capture_output=True, text=True, timeout=240
    )
    metrics = folder / "run" / "metrics.csv"
    return done, time.time() - metrics.stat().st_mtime


@pytest.mark.parametrize("failing", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_all_processes_stop_within_seconds_when_one_fails(tmp_path, failing):
    """The last row of the table is from the step of the failure."""
    done, seconds = torchrun(tmp_path, failing)
    assert done.returncode not in (0, None)
    assert "OSError: injected" in done.stderr
    assert not [*tmp_path.glob("* parted")]
    assert [row["step"] for row in rows(tmp_path / "run", "train")] == [1, 2, 3, 4, 5]
    assert seconds < 20  # on a busy machine; about one otherwise


def test_processes_that_torchrun_started_part_at_the_end(tmp_path):
    done, _ = torchrun(tmp_path, failing=-1)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"0 parted", "1 parted", "run"}
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"checkpoints", "metrics.csv"}
    assert make_part(tmp_path / "run", 0, 1, sizes=STILL, epochs=1, validation_buffer=None).resume()
