"""Offscreen pictures of MuJoCo models, by the GL library that ``MUJOCO_GL`` names.

GL is loaded at the first picture and not before: physics needs none. ``mujoco.Renderer`` is not used because it frees
its buffers without making its context current, which deletes those of other renderers, and because it prints
exceptions at the interpreter's exit. Here resources are released in an order that avoids both, by ``close``, by the
garbage collector and at exit.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import importlib
import os
import platform
import subprocess
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any, TYPE_CHECKING

import numpy as np

from torchrl_ficreg._mujoco import import_without_gl

if TYPE_CHECKING:
    import mujoco

BACKEND_VARIABLE = "MUJOCO_GL"
_ON = ("", "1", "on", "true", "enable", "enabled", "glx")  # MuJoCo's values for a window, which GLFW opens
_BACKENDS = ("egl", "osmesa", "glfw", "cgl")
_MAX_GEOMS = 2000  # of a scene, decorations included
_process: int | None = None  # that opened GL
_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
renderer = mujoco.Renderer(model, 8, 8)
renderer.update_scene(mujoco.MjData(model))
renderer.render()
renderer.close()
"""


def import_mujoco() -> ModuleType:
    """Imports MuJoCo such that it draws without a window.

    On Linux with an EGL library, sets ``MUJOCO_GL=egl`` unless it is set, for MuJoCo and the modules built on it. On a
    machine without a GL library MuJoCo is imported all the same: it simulates, and :class:`OffscreenRenderer` raises an
    error that names the missing packages.

    Returns:
        the module ``mujoco``.

    Raises:
        ImportError: MuJoCo is not installed.

    Examples:
        >>> mujoco = import_mujoco()
        >>> mujoco.MjModel.from_xml_string("<mujoco/>").nq
        0
    """
    if _has_egl():  # worker processes inherit the variable: without the library they could not even import TorchRL
        os.environ.setdefault(BACKEND_VARIABLE, "egl")
    try:
        return import_without_gl()
    except ModuleNotFoundError as error:
        raise ImportError(f"mujoco is not installed ({error}): {how_to_install('mujoco')}.") from error


def how_to_install(name: str) -> str:
    """The command that installs a simulator, for error messages.

    Args:
        name (str): name of its module.

    Examples:
        >>> how_to_install("mujoco")
        "pip install 'torchrl_ficreg[envs]'"
    """
    late = sys.version_info >= (3, 13) and name.partition(".")[0] in ("dm_control", "ogbench")
    return "pip install 'torchrl_ficreg[envs]'" + (", with Python 3.12 or older: labmaze has no later wheels" if late else "")


def _has_egl() -> bool:
    try:
        return platform.system() == "Linux" and bool(ctypes.CDLL("libEGL.so.1"))  # elsewhere MuJoCo refuses the value
    except OSError:
        return False


def _backend() -> str:
    default = "egl" if platform.system() == "Linux" else ""
    return os.environ.get(BACKEND_VARIABLE, default).strip().lower()


def gl_works() -> bool:
    """Whether pictures can be drawn here; a child process draws one, because a failure could end this process.

    Returns:
        True if MuJoCo is installed and draws with the present ``MUJOCO_GL``, EGL by default.
    """
    return _probe(_backend())


@functools.cache
def _probe(backend: str) -> bool:
    environment = {**os.environ, BACKEND_VARIABLE: backend}
    child = subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True, check=False)
    return child.returncode == 0


class MujocoHolder:
    """Makes objects that hold the module MuJoCo as ``_mujoco`` copyable and picklable."""

    _mujoco: ModuleType

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_mujoco"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _mujoco=import_mujoco())


class OffscreenRenderer:
    """Draws square pictures of one MuJoCo model into arrays; opens GL at the first of them.

    A process may have any number of them, beside other users of GL. A renderer belongs to the thread of its first draw.

    Args:
        model (mujoco.MjModel): the model to draw; the size of its own offscreen buffer does not matter.
        size (int): height and width of the pictures, in pixels.

    Raises:
        ValueError: ``size`` is not a positive integer.

    Examples:
        >>> mujoco = import_mujoco()
        >>> model = mujoco.MjModel.from_xml_string("<mujoco/>")
        >>> renderer = OffscreenRenderer(model, size=32)
        >>> if gl_works():
        ...     picture = renderer.draw(mujoco.MjData(model), camera=-1)
        >>> renderer.close()
    """

    def __init__(self, model: mujoco.MjModel, size: int) -> None:
        if not isinstance(size, int) or isinstance(size, bool) or size < 1:
            raise ValueError(f"size must be a positive integer, got {size!r}.")
        self._mujoco = import_mujoco()
        self._model = model
        self._size = size
        self._scene = self._mujoco.MjvScene(model, maxgeom=_MAX_GEOMS)
        self._option = self._mujoco.MjvOption()
        self._rectangle = self._mujoco.MjrRect(0, 0, size, size)
        self._buffer = np.empty((size, size, 3), np.uint8)
        self._surface: _Surface | None = None

    def __reduce__(self) -> tuple[type, tuple[Any, int]]:
        """A copy has a GL context of its own."""
        return type(self), (self._model, self._size)

    def draw(
        self,
        data: mujoco.MjData,
        camera: int | str | mujoco.MjvCamera,
        scene_option: mujoco.MjvOption | None = None,
    ) -> np.ndarray:
        """Draws the model in one state.

        Args:
            data (mujoco.MjData): the state, with the positions of its bodies, cameras and lights up to date.
            camera (int, str or mujoco.MjvCamera): number or name of a camera of the model, -1 for the free one, or
                another camera.
            scene_option (mujoco.MjvOption, optional): which groups and decorations are shown. Default: ``None``,
                MuJoCo's defaults.

        Returns:
            a new [3, size, size] uint8 array, red, green, blue; row 0 on top.

        Raises:
            ValueError: no such camera.
            RuntimeError: GL is missing or fails; the message names the packages to install. Or this process was
                forked from one that had drawn, where GL would deadlock.
        """
        mujoco = self._mujoco
        _refuse_fork()
        if self._surface is None:
            self._surface = _Surface(self._model, self._size)
        option = self._option if scene_option is None else scene_option
        category = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, option, None, self._find_camera(camera), category, self._scene)
        self._surface.read(self._rectangle, self._scene, self._buffer)
        # GL counts rows from below. np.array copies: the next picture overwrites the buffer.
        return np.array(self._buffer[::-1].transpose(2, 0, 1), order="C")

    def close(self) -> None:
        """Releases the GL resources; a later draw opens new ones."""
        if self._surface is not None:
            self._surface.close()
            self._surface = None

    def _find_camera(self, camera: int | str | mujoco.MjvCamera) -> mujoco.MjvCamera:
        mujoco, number = self._mujoco, camera
        if isinstance(camera, mujoco.MjvCamera):
            return camera
        if isinstance(camera, str):
            number = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA.value, camera)
        if not (-1 if number is camera else 0) <= number < self._model.ncam:
            names = [self._model.camera(index).name for index in range(self._model.ncam)]
            raise ValueError(f"no camera {camera!r}: choose one of {names}, its number, or -1 for the free camera.")
        found = mujoco.MjvCamera()
        if number == -1:
            mujoco.mjv_defaultFreeCamera(self._model, found)
        else:
            found.type = mujoco.mjtCamera.mjCAMERA_FIXED
            found.fixedcamid = number
        return found


class _Surface:
    """A GL context with MuJoCo's resources of one model in it, closed at the latest when the interpreter exits.

    Raises:
        RuntimeError: GL is missing or fails.
    """

    def __init__(self, model: mujoco.MjModel, size: int) -> None:
        global _process
        _process = os.getpid()
        self._mujoco = import_mujoco()
        backend = _backend()
        self._gl = None
        try:
            self._gl = _context_class(backend)(size, size)
            self._gl.make_current()
            with _buffer_size(model, size):
                self._context = self._mujoco.MjrContext(model, self._mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # each library of the chain raises exceptions of its own
            if self._gl is not None:
                self._gl.free()
            raise RuntimeError(_advice(backend, error)) from error
        self._mujoco.mjr_setBuffer(self._mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._release = weakref.finalize(self, _release, self._gl, self._context)
        # weakref's own exit hook may run after that of EGL, which terminates EGL. A hook registered now runs before it.
        self._release.atexit = False
        atexit.register(self._release)

    def read(self, rectangle: mujoco.MjrRect, scene: mujoco.MjvScene, out: np.ndarray) -> None:
        """Renders the scene into ``out`` [size, size, 3] uint8, the lowest row first."""
        self._gl.make_current()  # another context of this thread may be current
        self._mujoco.mjr_render(rectangle, scene, self._context)
        self._mujoco.mjr_readPixels(out, None, rectangle, self._context)

    def close(self) -> None:
        atexit.unregister(self._release)
        self._release()


def _was_forked() -> bool:
    """Whether GL was opened by the process that this one was forked from."""
    return _process not in (None, os.getpid())


def _refuse_fork() -> None:
    if _was_forked():
        raise RuntimeError(
            "this process was forked after its parent had drawn, and GL does not survive a fork: start processes by "
            "multiprocessing.get_context('spawn'), or fork before the first picture."
        )


def _release(gl: Any, context: Any) -> None:
    if _was_forked():  # they belong to the parent
        return
    try:
        # MuJoCo deletes buffers by number, and the numbers refer to the current context.
        gl.make_current()
        context.free()
    except Exception:  # GL has been terminated, and its resources are released
        pass
    gl.free()


def _context_class(backend: str) -> type:
    """MuJoCo's GL context class of a backend, whichever backend MuJoCo was imported with; freeing it never raises."""
    if backend in _ON:
        backend = "cgl" if platform.system() == "Darwin" else "glfw"
    if backend not in _BACKENDS:
        raise ImportError(f"{BACKEND_VARIABLE}={backend!r} allows no pictures")
    base = importlib.import_module(f"mujoco.{backend}").GLContext

    class QuietContext(base):
        _context = None  # read by free(), even when the constructor has failed

        def free(self) -> None:
            if _was_forked():
                return
            try:
                super().free()
            except Exception:  # terminated by another user of the same library: nothing is left to free
                self._context = None

        def __del__(self) -> None:
            try:
                self.free()
            except TypeError:  # at exit the names of this module may be None already
                pass

    return QuietContext


def _advice(backend: str, error: Exception) -> str:
    return (
        f"cannot draw with {BACKEND_VARIABLE}={backend!r} ({type(error).__name__}: {error}): MuJoCo's pictures need a "
        f"GL library. On Debian and Ubuntu, without GPU and display: apt-get install libegl1 libgl1, with "
        f"{BACKEND_VARIABLE}=egl, the default here; or apt-get install libosmesa6, with {BACKEND_VARIABLE}=osmesa. Set "
        f"the variable before Python starts. {BACKEND_VARIABLE}=glfw needs a display."
    )


@contextmanager
def _buffer_size(model: mujoco.MjModel, size: int) -> Iterator[None]:
    """Sets the offscreen buffer of a model to the size of the pictures within the context."""
    settings = model.vis.global_
    before = settings.offwidth, settings.offheight
    settings.offwidth = settings.offheight = size
    try:
        yield
    finally:
        settings.offwidth, settings.offheight = before
