"""Probes recover what latents hold, in physical units, and score it as the formulas say."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchrl_ficreg.envs.registry import find_entry
from torchrl_ficreg.evaluation import measure_states, Quantity, state_quantities, StateProbe

POSITION = Quantity("position", "px", size=2)
ANGLE = Quantity("angle", "deg", period=360.0)


def draw(rows: int = 2000, seed: int = 0) -> dict[str, torch.Tensor]:
    """Positions in a window of 100 px and angles of all directions."""
    rng = torch.Generator().manual_seed(seed)
    position = 100 * torch.rand(rows, 2, generator=rng)
    return {"position": position, "angle": 360 * torch.rand(rows, 1, generator=rng)}


def mixed(values: dict[str, torch.Tensor]) -> torch.Tensor:
    """Latents [N, 8] of which the targets of a probe are linear functions."""
    targets = torch.cat([values["position"] / 30, ANGLE.targets(values["angle"])], -1)  # [N, 4]
    return targets @ torch.randn(4, 8, generator=torch.Generator().manual_seed(1)) + 5


@pytest.mark.parametrize(
    ("quantity", "first", "second", "error"),
    [
        (POSITION, [1.0, 2.0], [4.0, 6.0], 5.0),
        (ANGLE, [350.0], [20.0], 30.0),
        (ANGLE, [-170.0], [190.0], 0.0),
        (Quantity("yaw", "deg", period=90.0), [80.0], [5.0], 15.0),
    ],
)
def test_errors_are_distances_and_shorter_ways_around(quantity, first, second, error):
    first, second = torch.tensor([first]), torch.tensor([second])
    assert quantity.error(first, second).item() == pytest.approx(error)
    assert quantity.error(quantity.values(quantity.targets(first)), first).item() == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize(("kind", "most"), [("ridge", 0.1), ("mlp", 2.0)])
def test_what_latents_hold_is_found_in_pixels_and_degrees(kind, most):
    train, test = draw(), draw(500, seed=1)
    probe = StateProbe([POSITION, ANGLE], kind, steps=300, width=64).fit(mixed(train), train)
    scores = probe.score(mixed(test), test)
    for name, unit, constant in (("position", "px", 38), ("angle", "deg", 90)):
        score = scores[name]
        assert score["unit"] == unit and score["median"] < most and score["median"] < score["p90"] and score["r2"] > 0.99
        assert score["constant"] == pytest.approx(constant, rel=0.15)  # a square's mean distance from its centre; a quarter turn
    decoded = probe(mixed(test).reshape(50, 10, -1))  # any leading dimensions
    assert decoded["position"].shape == (50, 10, 2) and decoded["angle"].shape == (50, 10, 1)


def test_r_and_r2_are_those_of_a_known_signal_to_noise_ratio():
    """A latent y + s e of a standardized y: the best linear estimate has r = 1 / sqrt(1 + s^2) and R^2 = r^2."""
    rng, s = torch.Generator().manual_seed(0), 0.75
    y = torch.randn(40_000, 1, generator=rng)
    latent = y + s * torch.randn(40_000, 1, generator=rng)
    probe = StateProbe([Quantity("y", "m")]).fit(latent[:20_000], {"y": y[:20_000]})
    score = probe.score(latent[20_000:], {"y": y[20_000:]})["y"]
    r2 = 1 / (1 + s**2)
    assert score["r2"] == pytest.approx(r2, abs=0.01) and score["r"] == pytest.approx(math.sqrt(r2), abs=0.01)
    std = s / math.sqrt(1 + s**2)  # of the normal error, whose absolute value has these quantiles
    assert score["median"] == pytest.approx(0.6745 * std, rel=0.03) and score["p90"] == pytest.approx(1.645 * std, rel=0.03)


def test_only_the_mlp_finds_what_is_not_linear():
    y = draw()["position"][:, :1] / 100
    latent = torch.cat([(5 * y).sin(), (5 * y).cos()], -1)
    r2 = {
        kind: StateProbe([Quantity("y", "m")], kind, steps=300, width=64).fit(latent, {"y": y}).score(latent, {"y": y})["y"]["r2"]
        for kind in ("ridge", "mlp")
    }
    assert r2["ridge"] < 0.9 < 0.98 < r2["mlp"]


def test_errors_of_predicted_latents_are_those_of_the_scene_they_show():
    """Latents of a scene 3 px and 4 px further are 5 px off, whatever the probe was fitted to."""
    train, test = draw(), draw(100, seed=1)
    probe = StateProbe([POSITION, ANGLE]).fit(mixed(train), train)
    moved = {**test, "position": test["position"] + torch.tensor([3.0, 4.0])}
    errors = probe.errors(mixed(moved).reshape(20, 5, -1), {k: v.reshape(20, 5, -1) for k, v in test.items()})
    torch.testing.assert_close(errors["position"], torch.full((20, 5), 5.0, dtype=torch.float64), atol=0.1, rtol=0)
    assert errors["angle"].max() < 0.5


def test_a_seed_gives_the_same_probe_and_leaves_the_global_generator_alone():
    train = draw(200)
    state = torch.random.get_rng_state()
    first, again, other = (
        StateProbe([POSITION], "mlp", steps=3, seed=seed).fit(mixed(train), train)(mixed(train))["position"]
        for seed in (0, 0, 1)
    )
    assert first.equal(again) and not first.equal(other) and torch.random.get_rng_state().equal(state)


def test_latents_without_information_and_values_without_variance_are_scored():
    values = {"position": draw(100)["position"], "angle": torch.zeros(100, 1)}
    scores = StateProbe([POSITION, ANGLE]).fit(torch.ones(100, 4), values).score(torch.ones(100, 4), values)
    assert scores["position"]["r2"] == pytest.approx(0, abs=1e-9) and scores["position"]["r"] == 0
    assert scores["position"]["median"] == scores["position"]["constant"] > 20
    assert scores["angle"]["r2"] is None and scores["angle"]["median"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda p, z, v: StateProbe([POSITION], "forest"), ValueError, "kind must be one of .*'forest'"),
        (lambda p, z, v: p(z), RuntimeError, "not fitted"),
        (lambda p, z, v: p.fit(z, {}), KeyError, "values of position are missing"),
        (lambda p, z, v: p.fit(z, {"position": v["angle"]}), ValueError, r"must be \[20, 2\] .*got \[20, 1\]"),
        (lambda p, z, v: p.fit(z * torch.nan, v), ValueError, "NaN or an infinity"),
        (lambda p, z, v: p.fit(z[None], {"position": v["position"][None]}), ValueError, r"\[N, D\] with N >= 2"),
        (lambda p, z, v: measure_states("atari", z), ValueError, "no quantities .*'atari': choose one of"),
    ],
)
def test_mistakes_are_named(call, error, message):
    values = draw(20)
    with pytest.raises(error, match=message):
        call(StateProbe([POSITION]), mixed(values), values)


@pytest.mark.parametrize("name", ["two_room", "push_t", "reacher"])
def test_states_give_every_quantity_under_its_name(name):
    """A state and one that looks the same have the same quantities up to the period, and a goal is within the tolerances."""
    env = find_entry(name).load_env()
    env = env()
    state = torch.from_numpy(np.stack([env._sample_state(np.random.default_rng(seed)) for seed in range(6)])).reshape(2, 3, -1)
    for key in (name, find_entry(name).gym_id):
        values = measure_states(key, state)
        assert list(values) == [quantity.name for quantity in state_quantities(key)]
    for quantity in state_quantities(name):
        assert values[quantity.name].shape == (2, 3, quantity.size) and values[quantity.name].dtype == torch.float64
    env.close()


def test_quantities_of_push_t_and_reacher_are_in_pixels_and_degrees():
    state = torch.tensor([1.0, 2.0, 3.0, 4.0, math.pi / 2, 5.0, 6.0], dtype=torch.float64)
    got = {name: value.tolist() for name, value in measure_states("push_t", state).items()}
    assert got == {"agent": [1, 2], "block": [3, 4], "block angle": [pytest.approx(90)], "agent velocity": [5, 6]}
    got = measure_states("reacher", torch.tensor([math.pi, -math.pi / 4, 0.5, -2.0], dtype=torch.float64))
    assert {name: round(value.item(), 6) for name, value in got.items()} == {
        "shoulder": 180.0,
        "wrist": -45.0,
        "shoulder velocity": 0.5,
        "wrist velocity": -2.0,
    }


def test_quantities_of_the_cube_come_from_its_arm():
    pytest.importorskip("ogbench")
    from torchrl_ficreg.envs.cube import CubeArm

    state = CubeArm().resting(arm_yaw=0.3, cube_position=[0.4, -0.1], cube_yaw=math.radians(95))
    values = measure_states("cube", torch.from_numpy(state).expand(2, -1))
    assert [values[quantity.name].shape for quantity in state_quantities("cube")] == [(2, 3), (2, 1), (2, 3), (2, 1), (2, 1)]
    torch.testing.assert_close(values["cube"][0], torch.tensor([0.4, -0.1, 0.02], dtype=torch.float64))
    torch.testing.assert_close(values["gripper"][1], torch.tensor([0.425, 0.0, 0.275], dtype=torch.float64), atol=1e-3, rtol=0)
    yaw = next(quantity for quantity in state_quantities("cube") if quantity.name == "cube yaw")
    assert yaw.error(values["cube yaw"][0], torch.tensor([5.0])).item() == pytest.approx(0, abs=1e-3)
