"""Pictures of the arm are dm_control's own without the target, and depend on the angles alone."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import numpy as np
import pytest

from torchrl_ficreg.envs._gl import gl_works
from torchrl_ficreg.envs.reacher import physics, ReacherEnv

for name in ("mujoco", "dm_control"):
    if importlib.util.find_spec(name) is None:
        pytest.skip(f"{name} is not installed: pip install 'torchrl_ficreg[envs]'", allow_module_level=True)
if not gl_works():
    pytest.skip("no GL here: apt-get install libegl1 libgl1", allow_module_level=True)

STATES = np.array([[0.5, 1.0, 0.0, 0.0], [-2.0, -2.85, 3.0, 4.0], [9.0, 0.0, -1.0, 0.0]])
STOCK = """
import sys
import numpy as np
from dm_control.suite import reacher
physics = reacher.hard(random=0).physics
physics.model.mat_rgba[physics.model.name2id("target", "material"), 3] = 0.0
pictures = []
for state in np.load(sys.argv[1]):
    physics.data.qpos[:], physics.data.qvel[:] = state[:2], state[2:]
    physics.forward()
    pictures.append(physics.render(224, 224, camera_id=0))
np.save(sys.argv[2], np.stack(pictures))
"""


@pytest.fixture(scope="module")
def env():
    env = ReacherEnv(image_size=64)
    yield env
    env.close()


def start(env, state):
    return env.reset(options={"state": state, "goal_state": np.zeros(4)})[0]


def test_the_picture_is_that_of_dm_control(tmp_path):
    """Against stock pictures of camera 0 at 224 px with a transparent target; drawn by another process."""
    np.save(tmp_path / "states.npy", STATES)
    files = [str(tmp_path / name) for name in ("states.npy", "pictures.npy")]
    subprocess.run([sys.executable, "-c", STOCK, *files], check=True, capture_output=True)
    env = ReacherEnv(image_size=224)
    for state, stock in zip(STATES, np.load(files[1]), strict=True):
        assert np.array_equal(start(env, state)["pixels"].transpose(1, 2, 0), stock)
    env.close()


def test_colours_and_light_are_those_of_the_published_data(env):
    model = env._model
    assert model.material("self").rgba.tolist() == pytest.approx([0.7, 0.5, 0.3, 1.0])
    assert model.material("target").rgba[3] == 0
    assert model.light("light").diffuse.tolist() == pytest.approx([0.7, 0.7, 0.7])
    checker = model.tex_data[model.texture("grid").adr[0] :][: 3 * 300 * 300].reshape(300, 300, 3)
    colours = np.unique(checker.reshape(-1, 3), axis=0) / 255
    np.testing.assert_allclose(colours, [[0.1, 0.2, 0.3], [0.2, 0.3, 0.4]], atol=1 / 255)
    camera = model.camera(0)
    assert camera.name == physics.CAMERA
    assert camera.pos.tolist() == [0, 0, 0.75]
    assert camera.fovy.item() == 45


def test_the_finger_is_drawn_at_the_position_of_the_angles(env):
    """Seen from 0.75 m at 45 degrees; the arm at height 0.01 m: x to the right, y up, from the centre."""
    still, bent = (start(env, state)["pixels"].astype(int) for state in ([0.0, 0, 0, 0], [0.0, np.pi / 2, 0, 0]))
    changed = np.abs(still - bent).sum(0) > 60
    scale = 64 / (2 * 0.74 * np.tan(np.pi / 8))  # px per m at that height
    for x, y in ((0.18, 0.0), (0.12, 0.06)):  # the middle of the hand, straight and bent
        assert changed[round(31.5 - y * scale), round(31.5 + x * scale)]
    assert not changed[:, :32].any()  # nothing to the left of the root


def test_velocities_and_full_turns_are_not_drawn(env):
    still = start(env, [0.5, 1.0, 0.0, 0.0])["pixels"]
    assert np.array_equal(start(env, [0.5, 1.0, 3.0, -3.0])["pixels"], still)
    turned = start(env, [0.5 + 2 * np.pi, 1.0, 0.0, 0.0])["pixels"].astype(int)
    assert np.abs(turned - still).max() <= 1  # rounding of the angle


def test_a_coarser_shadow_changes_little(env):
    coarse = ReacherEnv(image_size=64, shadow_size=512)
    pairs = [(start(env, state)["pixels"], start(coarse, state)["pixels"]) for state in STATES]
    coarse.close()
    fine, rough = (np.stack(pictures).astype(int) for pictures in zip(*pairs, strict=True))
    assert 0 < (fine != rough).mean() < 2e-3
    assert np.abs(fine - rough).mean() < 0.02


def test_a_closed_environment_draws_again():
    env = ReacherEnv(image_size=16)
    first = start(env, STATES[0])["pixels"]
    env.close()
    env.close()
    assert np.array_equal(start(env, STATES[0])["pixels"], first)
    env.close()
