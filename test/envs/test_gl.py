"""GL is touched late, given back quietly, and its absence is explained.

What happens at an interpreter's exit, or without a library, is tried in interpreters of its own, in which TorchRL loads
MuJoCo before this package can.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from torchrl_ficreg.envs import _gl as gl

if importlib.util.find_spec("mujoco") is None:
    pytest.skip("MuJoCo is not installed: pip install 'torchrl_ficreg[envs]'", allow_module_level=True)

needs_gl = pytest.mark.skipif(not gl.gl_works(), reason="no GL here: apt-get install libegl1 libgl1")
SCENE = """
<mujoco><worldbody>
  <light pos="0 0 3"/>
  <geom type="sphere" pos=".3 .2 0" size=".2" rgba="1 0 0 1"/>
  <camera name="above" pos="0 0 2"/>
  <camera name="near" pos=".3 .2 1"/>
</worldbody></mujoco>
"""
LACK = """
import ctypes, ctypes.util
def without(library):
    init, find = ctypes.CDLL.__init__, ctypes.util.find_library
    def refuse(self, name=None, *args, **kwargs):
        if library in str(name):
            raise OSError(f"{name}: cannot open shared object file")
        init(self, name, *args, **kwargs)
    ctypes.CDLL.__init__ = refuse
    ctypes.util.find_library = lambda name: None if name in library else find(name)
"""
LOAD = f"""
import ctypes, os, sys
from torchrl_ficreg.envs import _gl as gl
def scene():
    mujoco = gl.import_mujoco()
    model = mujoco.MjModel.from_xml_string({SCENE!r})
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data
"""


def python(code: str, folder: Path, lacks: str = "", **variables: str) -> subprocess.CompletedProcess:
    """Runs code in a fresh interpreter without a display and without a library, in which every warning is an error."""
    names = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "PYTHONPATH")
    environment = {key: value for key, value in os.environ.items() if key not in names} | variables
    script = folder / "script.py"
    script.write_text(LACK + (f"without({lacks!r})\n" if lacks else "") + LOAD + code)
    command = [sys.executable, "-W", "error", "-W", "ignore::DeprecationWarning", str(script)]
    return subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture
def scene():
    mujoco = gl.import_mujoco()
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def test_egl_is_the_default_and_the_users_choice_stays(tmp_path):
    code = "gl.import_mujoco(); print(os.environ['MUJOCO_GL'])"
    for choice in ("egl", "osmesa", "glfw", "off"):
        variables = {} if choice == "egl" else {"MUJOCO_GL": choice}
        assert python(code, tmp_path, **variables).stdout.strip() == choice


@needs_gl
def test_a_picture_is_a_new_contiguous_array_with_row_0_on_top(scene):
    model, data = scene
    renderer = gl.OffscreenRenderer(model, size=48)
    picture = renderer.draw(data, "above")
    assert picture.shape == (3, 48, 48)
    assert picture.dtype == np.uint8
    assert picture.flags.c_contiguous
    assert picture.flags.owndata
    rows, columns = np.nonzero(picture[0] > 50)  # the red ball is at x = 0.3 (right), y = 0.2 (up)
    assert columns.mean() > 24 > rows.mean()
    again = renderer.draw(data, 0)
    assert np.array_equal(again, picture)
    assert not np.shares_memory(again, picture)
    assert gl.OffscreenRenderer(model, size=1).draw(data, 0).flags.owndata
    renderer.close()


@needs_gl
def test_cameras_are_chosen_by_number_by_name_or_as_objects(scene):
    model, data = scene
    mujoco = gl.import_mujoco()
    renderer = gl.OffscreenRenderer(model, size=32)
    above, near, free = (renderer.draw(data, camera) for camera in ("above", 1, -1))
    assert not np.array_equal(above, near)
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    assert np.array_equal(renderer.draw(data, camera), free)
    for unknown in ("below", 2, -2):
        with pytest.raises(ValueError, match=r"choose one of \['above', 'near'\], its number, or -1"):
            renderer.draw(data, unknown)
    renderer.close()


@needs_gl
def test_options_decide_what_is_shown(scene):
    model, data = scene
    renderer = gl.OffscreenRenderer(model, size=32)
    nothing = gl.import_mujoco().MjvOption()
    nothing.geomgroup[:] = 0
    assert renderer.draw(data, 0).any()
    assert not renderer.draw(data, 0, scene_option=nothing).any()
    renderer.close()


@needs_gl
def test_pictures_may_be_larger_than_the_models_own_buffer(scene):
    """MuJoCo's default buffer is 640 x 480; it is left as it was."""
    model, data = scene
    renderer = gl.OffscreenRenderer(model, size=800)
    assert renderer.draw(data, 0).shape == (3, 800, 800)
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (640, 480)
    renderer.close()


@needs_gl
def test_renderers_do_not_disturb_each_other(scene):
    """Closing or dropping one, in any order, leaves the pictures of the others; a closed one may draw again."""
    model, data = scene
    renderers = [gl.OffscreenRenderer(model, size=size) for size in (16, 24, 32)]
    before = [renderer.draw(data, 0) for renderer in renderers]
    renderers[1].close()
    assert np.array_equal(renderers[0].draw(data, 0), before[0])
    assert np.array_equal(renderers[1].draw(data, 0), before[1])
    del renderers[0]
    for renderer, picture in zip(renderers, before[1:], strict=True):
        assert np.array_equal(renderer.draw(data, 0), picture)
        renderer.close()


def test_only_drawing_needs_gl(tmp_path):
    """Without the library one simulates; the first picture names the packages and the alternative."""
    code = """
model, data = scene()
renderer = gl.OffscreenRenderer(model, size=16)
gl.import_mujoco().mj_step(model, data)
print(data.time)
renderer.draw(data, 0)
"""
    result = python(code, tmp_path, lacks="libEGL")
    assert result.stdout.strip() == "0.002"
    message = result.stderr.strip().splitlines()[-1]
    assert message.startswith("RuntimeError: cannot draw with MUJOCO_GL='egl'")
    assert "apt-get install libegl1 libgl1" in message
    assert "apt-get install libosmesa6, with MUJOCO_GL=osmesa" in message
    assert "Exception ignored" not in result.stderr


@pytest.mark.parametrize("backend", ["osmesa", "nonsense", *(pytest.param(name, marks=pytest.mark.slow) for name in ("glfw", "off"))])
def test_a_backend_that_cannot_draw_here_is_named(backend, tmp_path):
    code = "model, data = scene(); gl.OffscreenRenderer(model, size=16).draw(data, 0)"
    result = python(code, tmp_path, lacks="OSMesa", MUJOCO_GL=backend, PYTHONWARNINGS="ignore")
    assert f"RuntimeError: cannot draw with MUJOCO_GL='{backend}'" in result.stderr
    assert "apt-get install libegl1 libgl1" in result.stderr
    assert "Exception ignored" not in result.stderr


@pytest.mark.parametrize("backend", ["egl", pytest.param("osmesa", marks=pytest.mark.slow)])
def test_nothing_is_said_at_exit(backend, tmp_path):
    """Renderers open, closed, dropped and in a cycle at exit; a worker that is ended, and one that is killed."""
    code = """
def draw(connection):
    model, data = scene()
    renderer = gl.OffscreenRenderer(model, size=16)
    connection.send(renderer.draw(data, 0).shape)
    connection.recv()
if __name__ == "__main__":
    import multiprocessing
    context = multiprocessing.get_context("spawn")
    model, data = scene()
    renderers = [gl.OffscreenRenderer(model, size=16) for _ in range(4)]
    pictures = [renderer.draw(data, 0) for renderer in renderers]
    renderers.pop().close()
    renderers.pop()
    cycle = [renderers.pop()]
    cycle.append(cycle)
    del cycle
    for end in ("terminate", "return"):
        ours, theirs = context.Pipe()
        process = context.Process(target=draw, args=(theirs,))
        process.start()
        print(ours.recv())
        if end == "terminate":
            process.terminate()
        else:
            ours.send(None)
        process.join()
"""
    if not works_with(backend):
        pytest.skip(f"no {backend} here: apt-get install {'libegl1 libgl1' if backend == 'egl' else 'libosmesa6'}")
    result = python(code, tmp_path, MUJOCO_GL=backend)
    assert result.stderr == ""
    assert result.stdout == "(3, 16, 16)\n" * 2
    assert [path.name for path in tmp_path.iterdir() if path.name != "__pycache__"] == ["script.py"]  # no log file


@needs_gl
def test_a_module_that_ends_egl_first_causes_no_noise(tmp_path):
    """dm_control's own hook ends EGL at exit; it is registered after ours here, and so runs before."""
    if importlib.util.find_spec("dm_control") is None:
        pytest.skip("dm_control is not installed: pip install 'torchrl_ficreg[envs]'")
    code = """
model, data = scene()
renderer = gl.OffscreenRenderer(model, size=16)
renderer.draw(data, 0)
gl.import_simulator("dm_control.mujoco")
"""
    assert python(code, tmp_path).stderr == ""


@needs_gl
def test_a_context_that_outlives_the_names_of_its_module_causes_no_noise(monkeypatch):
    """An interpreter that ends clears the names of modules, and deletes what is left only then."""
    context = object.__new__(gl._context_class("egl"))
    monkeypatch.setattr(gl, "_was_forked", None)
    context.__del__()


def works_with(backend: str) -> bool:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUJOCO_GL", backend)
        patch.delenv("PYOPENGL_PLATFORM", raising=False)
        return gl.gl_works()


def test_bad_arguments_are_refused(scene):
    with pytest.raises(ValueError, match="size must be a positive integer, got 0"):
        gl.OffscreenRenderer(scene[0], size=0)
    with pytest.raises(ImportError, match=r"no_such_simulator is not installed .*torchrl_ficreg\[envs\]"):
        gl.import_simulator("no_such_simulator")
