"""GL is loaded late and released without messages, and its absence is explained.

Exits of an interpreter, and machines without a library, are simulated in interpreters of their own.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import torchrl_ficreg
from torchrl_ficreg.envs import _gl as gl

if importlib.util.find_spec("mujoco") is None:
    pytest.skip("MuJoCo is not installed: pip install 'torchrl_ficreg[envs]'", allow_module_level=True)

ROOT = Path(torchrl_ficreg.__file__).parent
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
# The module alone, without the package and its imports: two seconds less per interpreter.
ALONE = f"""
import sys, types
for name, path in {{"torchrl_ficreg": {str(ROOT)!r}, "torchrl_ficreg.envs": {str(ROOT / "envs")!r}}}.items():
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = [path]
"""
LOAD = f"""
import os
from torchrl_ficreg.envs import _gl as gl
def scene():
    mujoco = gl.import_mujoco()
    model = mujoco.MjModel.from_xml_string({SCENE!r})
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data
def draw():
    model, data = scene()
    return gl.OffscreenRenderer(model, size=16).draw(data, 0)
"""


def python(
    code: str, folder: Path, lacks: str = "", package: bool = False, **variables: str
) -> subprocess.CompletedProcess:
    """Runs code in a fresh interpreter without a display and without a library, in which every warning is an error.

    With ``package`` it imports the whole package, and TorchRL loads MuJoCo before this module can.
    """
    names = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "PYTHONPATH")
    environment = {key: value for key, value in os.environ.items() if key not in names} | variables
    environment["PYTHONPATH"] = str(ROOT.parent)
    script = folder / "script.py"
    script.write_text(LACK + (f"without({lacks!r})\n" if lacks else "") + ("" if package else ALONE) + LOAD + code)
    command = [sys.executable, "-W", "error", "-W", "ignore::DeprecationWarning", str(script)]
    return subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture
def scene():
    mujoco = gl.import_mujoco()
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.skipif(not gl._has_egl(), reason="no EGL library")
def test_egl_is_the_default_and_another_choice_is_kept(monkeypatch):
    for choice in (None, "osmesa", "glfw", "off"):
        monkeypatch.delenv("MUJOCO_GL", raising=False) if choice is None else monkeypatch.setenv("MUJOCO_GL", choice)
        gl.import_mujoco()
        assert os.environ["MUJOCO_GL"] == (choice or "egl")


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
    """Without the library the package is imported and simulates; a picture is an error that names the packages."""
    code = """
model, data = scene()
renderer = gl.OffscreenRenderer(model, size=16)
gl.import_mujoco().mj_step(model, data)
print(data.time)
renderer.draw(data, 0)
"""
    result = python(code, tmp_path, lacks="libEGL", package=True)
    assert result.stdout.strip() == "0.002"
    message = result.stderr.strip().splitlines()[-1]
    assert message.startswith("RuntimeError: cannot draw with MUJOCO_GL='egl'")
    assert "apt-get install libegl1 libgl1" in message
    assert "apt-get install libosmesa6, with MUJOCO_GL=osmesa" in message
    assert "Exception ignored" not in result.stderr


@pytest.mark.parametrize("backends", [["osmesa"], ["nonsense", "glfw", "off"]])
def test_a_backend_that_cannot_draw_here_is_named(backends, tmp_path):
    """MuJoCo's own import fails with the first of them, and so would that of TorchRL."""
    code = f"""
for backend in {backends}:
    os.environ["MUJOCO_GL"] = backend
    try:
        draw()
    except RuntimeError as error:
        print(error)
"""
    result = python(code, tmp_path, lacks="OSMesa", package=True, MUJOCO_GL=backends[0], PYTHONWARNINGS="ignore")
    messages = result.stdout.splitlines()
    assert len(messages) == len(backends), result.stderr
    for backend, message in zip(backends, messages):
        assert message.startswith(f"cannot draw with MUJOCO_GL='{backend}'") and "apt-get install libegl1 libgl1" in message
    assert "Exception ignored" not in result.stderr


@pytest.mark.parametrize("backend", ["egl", pytest.param("osmesa", marks=pytest.mark.slow)])
def test_nothing_is_printed_at_exit(backend, tmp_path):
    """Renderers open, closed, dropped and in a cycle at exit; a worker that is ended, and one that is killed."""
    code = """
def work(connection):
    connection.send(draw().shape)
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
        process = context.Process(target=work, args=(theirs,))
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
def test_a_module_that_terminates_egl_first_causes_no_message(tmp_path):
    """dm_control's own hook ends EGL at exit; it is registered after ours here, and so runs before."""
    if importlib.util.find_spec("dm_control") is None:
        pytest.skip("dm_control is not installed: pip install 'torchrl_ficreg[envs]'")
    code = """
model, data = scene()
renderer = gl.OffscreenRenderer(model, size=16)
renderer.draw(data, 0)
import dm_control.mujoco
"""
    result = python(code, tmp_path)
    assert (result.returncode, result.stderr) == (0, "")


@needs_gl
def test_a_context_that_outlives_the_names_of_its_module_causes_no_message(monkeypatch):
    """An interpreter that ends clears the names of modules, and deletes what is left only then."""
    context = object.__new__(gl._context_class("egl"))
    monkeypatch.setattr(gl, "_was_forked", None)
    context.__del__()


def works_with(backend: str) -> bool:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUJOCO_GL", backend)
        patch.delenv("PYOPENGL_PLATFORM", raising=False)
        return gl.gl_works()


def test_bad_arguments_and_a_missing_package_are_refused(scene, monkeypatch):
    with pytest.raises(ValueError, match="size must be a positive integer, got 0"):
        gl.OffscreenRenderer(scene[0], size=0)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"mujoco is not installed .*torchrl_ficreg\[envs\]"):
        gl.import_mujoco()
