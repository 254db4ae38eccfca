"""The lag between actions and states is found for actions and states of any kind; a shifted file is refused and repaired."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from foreign_files import write_lewm

from torchrl_ficreg.data.convert import convert, measure_alignment, open_source, verify_alignment
from torchrl_ficreg.data.store import EpisodeStore


def drive(rng, *, length=80, smooth=0.0, noise=0.0, gain=1.0, idle=0):
    """s[t+1] = s[t] + gain a[t] + noise, with so many components that wander by themselves."""
    action = rng.normal(size=(length, 2))
    for step in range(1, length):
        action[step] = smooth * action[step - 1] + (1 - smooth**2) ** 0.5 * action[step]
    moved = gain * action[:-1] + noise * rng.normal(size=(length - 1, 2))
    state = np.concatenate([np.zeros((1, 2)), moved.cumsum(0)])
    wander = rng.normal(size=(length, idle)).cumsum(0)
    action[-1] = np.nan
    return action, np.concatenate([state, wander], 1)


def stored(episodes, lag):
    """The same episodes by a recorder that puts actions elsewhere; lag -1 is the row an action leads to."""
    return [(np.roll(action, -lag, axis=0), state) for action, state in episodes]


@pytest.mark.parametrize("lag", [-1, 0, 1])
@pytest.mark.parametrize(
    "settings",
    [{}, {"smooth": 0.95}, {"smooth": 0.995}, {"noise": 1.5}, {"noise": 1.0, "smooth": 0.8}, {"idle": 39}, {"gain": 1e-4}],
)
def test_the_lag_is_found(lag, settings):
    rng = np.random.default_rng(0)
    found = measure_alignment(stored([drive(rng, **settings) for _ in range(30)], lag))
    assert found.lag == lag and found.change == "difference" and max(found.r2, key=found.r2.get) == lag


def test_the_shares_are_those_of_the_formula():
    """With noise of the actions' own size half of the variance is explained; one row off, a first-order process with
    autocorrelation c keeps c squared of it."""
    rng = np.random.default_rng(0)
    found = measure_alignment([drive(rng, noise=1.0, smooth=0.6, length=400) for _ in range(50)])
    assert found.r2[0] == pytest.approx(0.5, abs=0.02)
    assert found.r2[-1] == pytest.approx(0.5 * 0.36, abs=0.02)
    assert found.r2[1] == pytest.approx(0.5 * 0.36, abs=0.02) and found.rows == 50 * 399


@pytest.mark.parametrize("lag", [-1, 0])
def test_forces_show_in_the_second_difference(lag):
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(30):
        action = rng.normal(size=(200, 2))
        velocity = 10 * rng.normal(size=(1, 2)) + action[:-1].cumsum(0)  # semi-implicit: the new velocity moves it
        velocity *= 10
        episodes.append((action, np.concatenate([np.zeros((1, 2)), velocity.cumsum(0)])))
    found = measure_alignment(stored(episodes, lag))
    assert (found.change, found.lag) == ("second difference", lag)


def test_positions_to_be_reached_are_understood():
    """A robot that closes half of the gap to its target; targets jump and are unrelated to where it is."""
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(30):
        target = np.repeat(rng.normal(size=(50, 3)), 3, axis=0) * 3 + 100 * rng.normal(size=(1, 3))
        state = [target[0] + rng.normal(size=3)]
        for goal in target[:-1]:
            state.append(state[-1] + 0.5 * (goal - state[-1]))
        episodes.append((target, np.array(state)))
    found = measure_alignment(episodes)
    assert (found.change, found.lag) == ("target", 0)


def test_unrelated_actions_and_overflowing_states_have_no_lag():
    rng = np.random.default_rng(0)
    action = [rng.normal(size=(100, 2)) for _ in range(20)]
    moved = np.concatenate([np.zeros((1, 2)), action[0].cumsum(0)[:-1]])
    with np.errstate(over="ignore", invalid="ignore"):
        for episodes in (
            [(one, rng.normal(size=(100, 40)).cumsum(0)) for one in action],
            [(one, np.ones((100, 3))) for one in action],
            [(np.roll(action[0], 1, 0), 1e200 * moved)],
        ):
            assert measure_alignment(episodes).lag is None


@pytest.mark.parametrize("lag", [-1, 1])
def test_a_shifted_file_is_refused_and_repaired(tmp_path, make_rows, expected, lag):
    rows = make_rows([60, 50, 70])
    want = expected(rows)
    stops = rows["ep_len"].cumsum()
    for start, stop in zip(stops - rows["ep_len"], stops):
        rows["action"][start:stop] = np.roll(rows["action"][start:stop], -lag, axis=0)
    path = write_lewm(tmp_path / "shifted.h5", rows)
    with pytest.raises(ValueError, match=rf"the lag is \{lag:+d} .*correct it by shift={lag}"):
        convert(path, tmp_path / "refused", progress=False)
    assert not (tmp_path / "refused").exists()
    with open_source(path, shift=lag) as source:
        assert verify_alignment(source).lag == 0
        target = convert(source, tmp_path / "repaired", progress=False)
    store = EpisodeStore.open(target)
    for number, episode in enumerate(want, start=1):
        cut = max(lag, 0)  # the first row's action was never stored
        for key in ("action", "state"):
            np.testing.assert_array_equal(store.arrays[key][store.rows(number)], episode[key][cut:])


def test_a_file_of_actions_that_explain_nothing_or_of_few_rows_passes_with_a_warning(tmp_path, make_rows):
    rows = make_rows([100, 100])
    rows["state"] = np.random.default_rng(1).normal(size=rows["state"].shape)
    path = write_lewm(tmp_path / "x.h5", rows)
    with pytest.warns(UserWarning, match="no lag explains more than 10%.*by state="):
        convert(path, tmp_path / "a", progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        convert(path, tmp_path / "b", check_alignment=False, progress=False)
    with open_source(write_lewm(tmp_path / "few.h5", make_rows([12, 12]))) as source:
        with pytest.warns(UserWarning, match="24 rows are too few"):
            assert verify_alignment(source) is None
