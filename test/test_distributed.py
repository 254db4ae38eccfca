"""Claims about several ranks: statistics of a batch are those of the global batch, and a training step is that of one process.

The convention is that of distributed data parallel training: gradients are averaged over ranks. So the average over
ranks of parameter gradients, and each rank's gradient of its own latents divided by the number of ranks, must be those
of one process on the concatenated batch.
"""

from __future__ import annotations

import warnings
from types import SimpleNamespace

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from _losses import make_clip, make_loss
from tensordict import TensorDict
from torch import nn

from torchrl_ficreg import SIGReg
from torchrl_ficreg.distributed import all_gather
from torchrl_ficreg.modules.layers import GlobalBatchNorm1d
from torchrl_ficreg.trainers import CollapseMonitor

TIMES, DIM, DTYPE = 3, 5, torch.float64
SIZES = {2: {"equal": [8, 8], "unequal": [3, 13]}, 4: {"equal": [4, 4, 4, 4], "unequal": [2, 5, 3, 6]}}
STEPS = ("paper", "live", "trusted", "two_steps", "lewm", "joint", "pldm")  # losses that take a training step
MASKED_STEPS = ("paper", "pldm")
NORMS = {"default": {}, "average": {"momentum": None}, "plain": {"affine": False}, "stateless": {"track_running_stats": False}}


def noise(*shape: int, seed: int = 0, dtype: torch.dtype = DTYPE) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def statistic(rows: slice, masked: bool, unit: str, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    """SIGReg of latents that a linear map makes: value, gradients of map and latents, and the state it is left in."""
    weight = torch.eye(DIM, dtype=dtype).add(0.1 * noise(DIM, DIM, seed=2, dtype=dtype)).requires_grad_()
    latent = 1.5 * noise(TIMES, 16, DIM, dtype=dtype)[:, rows] @ weight  # [T, B of this rank, D]
    latent.retain_grad()
    mask = (noise(TIMES, 16, seed=3) > -0.5)[:, rows] if masked else None
    sigreg = SIGReg(32, unit=unit)
    sigreg(latent.detach(), mask)
    value = sigreg(latent, mask)
    (2 * value).backward()
    return {"value": value.detach(), "weight": weight.grad, "latent": latent.grad, "state": sigreg.generator_state}


def normed(rows: slice, kind: str, length: int | None) -> dict[str, torch.Tensor]:
    """Two training calls of a BatchNorm layer, and one in eval mode: outputs, gradients, state."""
    norm = GlobalBatchNorm1d(DIM, dtype=DTYPE, **NORMS[kind])
    if norm.affine:
        with torch.no_grad():
            norm.weight.copy_(noise(DIM, seed=4))
            norm.bias.copy_(noise(DIM, seed=5))
    shape = (16, DIM) if length is None else (16, DIM, length)
    result = {}
    for call in range(2):
        x = (3 + 2 * noise(*shape, seed=call))[rows].requires_grad_()
        norm.zero_grad()
        y = norm(x)
        (y * noise(*shape, seed=7)[rows]).sum().backward()
        result |= {f"output {call}": y.detach(), f"input {call}": x.grad}
    result |= {name: param.grad for name, param in norm.named_parameters()} | dict(norm.named_buffers())
    return result | {"eval": norm.eval()(noise(*shape, seed=8)).detach()}


def make_batch(seed: int, masked: bool) -> TensorDict:
    """Sixteen clips in float64; with masks, no transition of the first half counts and some of the others do."""
    clip = make_clip(16, seed=seed)
    clip["pixels"], clip["action"] = clip["pixels"].to(DTYPE) / 255, clip["action"].to(DTYPE)
    if masked:
        clip["mask"] = (noise(16, 3, seed=seed) > 0) & (torch.arange(16) >= 8)[:, None]
    return clip


def gathered(rows: slice) -> dict[str, torch.Tensor]:
    """The local batches gathered, of three dtypes, and the gradient of a statistic of the global batch."""
    x = noise(3, 16, DIM)
    mine = x[:, rows].clone().requires_grad_()
    all_gather(mine, 1).var(1).square().sum().backward()
    batches = {str(value.dtype): all_gather(value[:, rows], -2) for value in (x, x.bfloat16(), x > 0)}
    return {**batches, "gradient": mine.grad}


def watched(rows: slice) -> dict[str, torch.Tensor]:
    """Diagnostics of a loss, and those of CollapseMonitor, in float64."""
    loss, clip = make_loss("diagnostics", dropout=0.0, consistency="trusted").to(DTYPE), make_batch(0, masked=True)[rows]
    clip["mask"] = noise(16, 3, seed=1)[rows] > -0.5
    result = {key: value.detach() for key, value in loss(clip).items() if key.startswith("judge")}
    alarm = CollapseMonitor(1, "fp32")
    alarm._trainer = SimpleNamespace(_optim_count=1, loss_module=loss)
    return result | {key: torch.tensor(value) for key, value in alarm(clip).items()}


def trained(name: str, rows: slice, parallel: bool, masked: bool) -> dict[str, torch.Tensor]:
    """State of a loss after two steps of SGD, in float64."""
    loss = make_loss(name, dropout=0.0).to(DTYPE)
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    call = nn.parallel.DistributedDataParallel(loss) if parallel else loss
    for seed in range(2):
        optimizer.zero_grad()
        sum(call(make_batch(seed, masked)[rows]).values()).backward()
        optimizer.step()
    return {key: value.clone() for key, value in loss.state_dict().items()}


def scenarios(rows: dict[str, slice], world: int) -> dict[tuple, dict[str, torch.Tensor]]:
    result = {}
    for sizes, local in rows.items():
        for masked in (False, True):
            for unit in ("time", "batch_time"):
                for dtype in (torch.float32, torch.float64):
                    result["sigreg", sizes, masked, unit, dtype] = statistic(local, masked, unit, dtype)
        for kind in NORMS:
            for length in (None, 3):
                result["norm", sizes, kind, length] = normed(local, kind, length)
    for name in STEPS if world <= 2 else ("paper",):
        result["step", name] = trained(name, rows["equal"], world > 1, masked=False)
    for name in MASKED_STEPS:
        result["masked step", name] = trained(name, rows["equal"], world > 1, masked=True)
    result["gathered",], result["watched",] = gathered(rows["equal"]), watched(rows["equal"])
    return result


def work(rank: int, world: int, folder: str) -> None:
    warnings.simplefilter("ignore")
    warnings.filterwarnings("error", r"torch\.distributed")  # deprecated functions
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=world)
    try:
        rows = {}
        for name, sizes in SIZES[world].items():
            start = sum(sizes[:rank])
            rows[name] = slice(start, start + sizes[rank])
        torch.save(scenarios(rows, world), f"{folder}/{rank}.pt")
        dist.barrier()
    finally:
        dist.destroy_process_group()


@pytest.fixture(scope="module")
def single():
    """Results of one process on the global batch."""
    return scenarios({"equal": slice(None), "unequal": slice(None)}, 1)


@pytest.fixture(scope="module", params=[2, pytest.param(4, marks=pytest.mark.slow)])
def ranks(request, tmp_path_factory):
    """Results of each rank on its local batch."""
    folder = str(tmp_path_factory.mktemp("ranks"))
    mp.start_processes(work, args=(request.param, folder), nprocs=request.param, start_method="forkserver")
    return [torch.load(f"{folder}/{rank}.pt", weights_only=False) for rank in range(request.param)]


def relative(ours: torch.Tensor, expected: torch.Tensor) -> float:
    return ((ours - expected).norm() / expected.norm()).item()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("unit", ["time", "batch_time"])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("sizes", ["equal", "unequal"])
def test_sigreg_is_that_of_the_global_batch(ranks, single, sizes, masked, unit, dtype):
    """Value and gradients within 1e-5 (float64: 1e-12), whatever the sizes of local batches, and the same state."""
    key = ("sigreg", sizes, masked, unit, dtype)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    expected, results = single[key], [rank[key] for rank in ranks]
    for result in results:
        assert relative(result["value"], expected["value"]) < tolerance
        assert result["state"].equal(expected["state"])
    assert relative(sum(result["weight"] for result in results) / len(results), expected["weight"]) < tolerance
    latent = torch.cat([result["latent"] for result in results], 1) / len(results)
    assert relative(latent, expected["latent"]) < tolerance


@pytest.mark.parametrize("length", [None, 3])
@pytest.mark.parametrize("kind", NORMS)
@pytest.mark.parametrize("sizes", ["equal", "unequal"])
def test_batch_norm_is_that_of_the_global_batch(ranks, single, sizes, kind, length):
    """Outputs, running statistics and gradients; the loss here is a sum over samples, so gradients add up."""
    key = ("norm", sizes, kind, length)
    expected, results = single[key], [rank[key] for rank in ranks]
    for name, value in expected.items():
        if name.startswith(("output", "input")):
            ours = torch.cat([result[name] for result in results])
        elif name in ("weight", "bias"):
            ours = sum(result[name] for result in results)
        else:
            if name == "eval" and kind == "stateless":
                continue  # the same batch on every rank
            assert all(result[name].equal(results[0][name]) for result in results), name
            ours = results[0][name]
        torch.testing.assert_close(ours, value, rtol=1e-10, atol=1e-12, msg=lambda text, name=name: f"{name}: {text}")


@pytest.mark.parametrize(("kind", "name"), [*(("step", name) for name in STEPS), *(("masked step", n) for n in MASKED_STEPS)])
def test_training_steps_are_those_of_one_process_on_the_whole_batch(ranks, single, kind, name):
    """Parameters, BatchNorm statistics and generator state agree to 1e-9, on all ranks.

    Masks leave no transition at all on the first half of the ranks.
    """
    if (kind, name) not in ranks[0]:
        pytest.skip("on two processes only")
    expected, start = single[kind, name], make_loss(name, dropout=0.0).to(DTYPE).state_dict()
    moved = [key for key in expected if not start[key].equal(expected[key])]
    assert any(key.startswith("predictor_params") for key in moved)
    for rank in ranks:
        for entry, value in rank[kind, name].items():
            assert value.shape == expected[entry].shape, entry
            assert value.allclose(expected[entry], rtol=1e-9, atol=1e-9), entry


def test_gathered_local_batches_are_the_global_batch(ranks, single):
    """To the last bit, on every rank; the average of gradients is that of one process."""
    expected, results = single["gathered",], [rank["gathered",] for rank in ranks]
    gradient = torch.cat([result.pop("gradient") for result in results], 1) / len(results)
    torch.testing.assert_close(gradient, expected["gradient"], rtol=1e-12, atol=1e-14)
    for result in results:
        assert len(result) == 3
        assert all(value.equal(expected[dtype]) for dtype, value in result.items())


def test_diagnostics_are_those_of_the_global_batch(ranks, single):
    """R² and reliability of the inverse model, and the measures of collapse: the same numbers on every rank."""
    expected = single["watched",]
    assert len(expected) == 7
    for rank in ranks:
        torch.testing.assert_close(rank["watched",], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", NORMS)
@pytest.mark.parametrize("shape", [(16, DIM), (16, DIM, 3)])
def test_in_one_process_it_is_batch_norm_to_the_last_bit(kind, shape):
    ours, theirs = GlobalBatchNorm1d(DIM, **NORMS[kind]), nn.BatchNorm1d(DIM, **NORMS[kind])
    assert list(ours.state_dict()) == list(theirs.state_dict())
    for mode in (True, True, False):
        results = []
        for norm in (ours, theirs):
            x = noise(*shape, dtype=torch.float32).requires_grad_()
            y = norm.train(mode)(x)
            y.square().sum().backward()
            results.append([y, x.grad, *(p.grad for p in norm.parameters()), *norm.buffers()])
        assert all(one.equal(other) for one, other in zip(*results, strict=True))
