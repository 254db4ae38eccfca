"""Turns a mistake on the command line, or in the data, into one line that says what to do."""

from __future__ import annotations

import difflib
import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path

import hydra
from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from torchrl_ficreg.trainers import exit_on_signal, Preempted
from torchrl_ficreg.trainers.distributed import launched

INTERRUPTED = "interrupted: the same command continues from what is on disk."
SWEEP_OF_PROCESSES = (  # which would meet a second time at the second job, and hang
    "error: under torchrun a sweep is one command for each run: start torchrun once per seed, or use -m with "
    "hydra/launcher=slurm."
)
SWEEP_WITH_FAILURES = "error: not all runs of the sweep succeeded; the same command leaves those that did as they are."
LAUNCHERS = {"processes": ("hydra_joblib_launcher", "sweep"), "slurm": ("hydra_submitit_launcher", "slurm")}
CONFIG_DIR = Path(__file__).resolve().parent / "config"

# What a user can cause and mend. A defect of ours shows its traceback, as does everything under HYDRA_FULL_ERROR=1.
MISTAKES = (
    ValueError,
    TypeError,
    KeyError,
    ImportError,
    OSError,
    FloatingPointError,
    RuntimeError,
    OmegaConfBaseException,
)


class JobFailed(Exception):
    """One run of a sweep; what went wrong has been said. The others go on."""


def entry_point(config_name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Decorates the main function of a script: Hydra in front, one-line errors around it."""

    wanted_whole = os.environ.get("HYDRA_FULL_ERROR") == "1"

    def decorate(main: Callable[[DictConfig], None]) -> Callable[[], None]:
        def run(config: DictConfig) -> None:
            try:
                with exit_on_signal():
                    main(config)
            except Preempted as stop:
                _close_bars()
                print(stop, file=sys.stderr)
                raise
            except KeyboardInterrupt:
                _close_bars()
                sys.exit(INTERRUPTED)
            except MISTAKES as error:
                if wanted_whole:
                    raise
                _close_bars()
                line = f"error: {_one_line(error)}"
                if HydraConfig.get().mode != RunMode.MULTIRUN:
                    sys.exit(line)
                print(f"{line} (run {config.get('name')})", file=sys.stderr)
                raise JobFailed(line) from None

        run.__module__ = main.__module__
        start = hydra.main(config_path=str(CONFIG_DIR), config_name=config_name, version_base="1.3")(run)

        def checked() -> None:
            arguments = get_args_parser().parse_args()
            if arguments.multirun and launched():
                sys.exit(SWEEP_OF_PROCESSES)
            if arguments.multirun:
                _let_jobs_import_us()
                os.environ["HYDRA_FULL_ERROR"] = "1"  # lets JobFailed through to here
            try:
                check_launcher(arguments.overrides)
                check_overrides(config_name, arguments.overrides)
            except (ValueError, HydraException, OmegaConfBaseException) as error:
                sys.exit(f"error: {_one_line(error)}")
            try:
                start()  # what it raises has been put into words, or is wanted whole (HYDRA_FULL_ERROR)
            except JobFailed:
                sys.exit(SWEEP_WITH_FAILURES)
            except KeyboardInterrupt:
                sys.exit(INTERRUPTED)

        return checked

    return decorate


def _let_jobs_import_us() -> None:
    """A job of a sweep is unpickled in a process that was not started with this folder's scripts."""
    inherited = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(CONFIG_DIR.parent), *([inherited] if inherited else [])])


def check_launcher(arguments: list[str]) -> None:
    """Refuses a launcher whose package is missing.

    Raises:
        ValueError: with the package's name.
    """
    for argument in arguments:
        plugin, extra = LAUNCHERS.get(argument.removeprefix("hydra/launcher="), (None, None))
        if plugin is not None and not _installed(f"hydra_plugins.{plugin}"):
            raise ValueError(f"{argument} needs a package: pip install 'torchrl_ficreg[{extra}]'.")


def _installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # not even the package around it
        return False


def check_overrides(config_name: str, arguments: list[str]) -> None:
    """Refuses fields that no configuration file declares, and values of another kind.

    Raises:
        ValueError: an unknown field, with the nearest known one; or a value of another type.
    """
    overrides = [override for override in OverridesParser.create().parse_overrides(arguments)]
    groups = {path.name for path in CONFIG_DIR.iterdir() if path.is_dir()}
    chosen = [o.input_line for o in overrides if o.key_or_group in groups and not o.is_sweep_override()]
    for override in overrides:
        if override.key_or_group in groups and not override.is_sweep_override():
            options = sorted(path.stem for path in (CONFIG_DIR / override.key_or_group).glob("[!_]*.yaml"))
            if override.value() not in options:
                raise ValueError(f"{override.key_or_group}={override.value()} is unknown: choose one of {options}.")
    with initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
        declared = compose(config_name, chosen)
    known = [*sorted(groups), *(path for path, _ in _leaves(declared))]
    for override in overrides:
        key = override.key_or_group
        if key in groups or key.startswith(("hydra.", "hydra/")):  # Hydra checks its own
            continue
        if override.is_add() or override.is_delete() or not _declares(declared, key):
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.3)
            hint = f"did you mean {near[0]!r}?" if near else f"see {CONFIG_DIR.name}/{config_name}.yaml."
            raise ValueError(f"{override.input_line!r}: there is no field {key!r} to change; {hint}")
        _check_value(declared, key, override)


def _check_value(declared: DictConfig, key: str, override: Override) -> None:
    """A number stays a number, a list a list; a field declared null takes anything."""
    node = declared._get_node(key) if "." not in key else None
    if node is not None and node._is_missing():
        return
    present = OmegaConf.select(declared, key)
    if override.is_sweep_override() or present is None:
        return
    value = override.value()
    numbers = (int, float)
    same = isinstance(value, type(present)) and not (isinstance(value, bool) ^ isinstance(present, bool))
    if isinstance(present, float):
        same = isinstance(value, numbers) and not isinstance(value, bool)
    elif isinstance(present, str):
        same = not isinstance(value, (dict, list))
    elif isinstance(present, (DictConfig, ListConfig)):
        same = isinstance(value, (dict, list))
    if not same:
        raise ValueError(f"{override.input_line!r}: expected a value like {present!r}, got {value!r}.")


def _declares(config: DictConfig, key: str) -> bool:
    node = config
    for part in key.split("."):
        if not isinstance(node, DictConfig) or part not in node._content:
            return False
        node = node._get_node(part)
    return True


def _leaves(config: DictConfig, prefix: str = "") -> list[tuple[str, object]]:
    leaves = []
    for key in config:
        node = config._get_node(key)
        path = f"{prefix}{key}"
        leaves += _leaves(node, f"{path}.") if isinstance(node, DictConfig) else [(path, node)]
    return leaves


def _close_bars() -> None:
    """Ends unfinished progress bars, so that the message gets a line of its own."""
    for bar in list(getattr(tqdm, "_instances", [])):
        bar.close()


def _one_line(error: Exception) -> str:
    text = error.args[0] if isinstance(error, KeyError) and error.args else error
    return " ".join(str(text).split())
