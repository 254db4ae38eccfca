"""Turns a mistake on the command line, or in the data, into one line that says what to do."""

from __future__ import annotations

import difflib
import importlib.util
import os
import signal
import sys
import traceback
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

from torchrl_ficreg.distributed import launched
from torchrl_ficreg.trainers import exit_on_signal, Preempted

INTERRUPTED = "interrupted: the same command continues from what is on disk."
SWEEP_OF_PROCESSES = (  # which would meet a second time at the second job, and hang
    "error: under torchrun a sweep is one command for each run: start torchrun once per seed, or use -m with "
    "hydra/launcher=slurm."
)
SWEEP_WITH_FAILURES = "error: not all runs of the sweep succeeded; the same command leaves those that did as they are."
LAUNCHERS = {"processes": ("hydra_joblib_launcher", "sweep"), "slurm": ("hydra_submitit_launcher", "slurm")}
CONFIG_DIR = Path(__file__).resolve().parent / "config"

# Settings that name files and folders: any path is taken as it stands, and ~ is the home folder.
PATHS = ("source", "target", "dataset", "data_dir", "runs_dir", "resume", "checkpoint", "pairs", "output", "plan.policy")

MOST_CHARACTERS = 1000  # of an error: some libraries quote whole files

# What a user can cause and mend has a message of its own; other errors are named by their kind as well.
MISTAKES = (ValueError, TypeError, KeyError, ImportError, OSError, FloatingPointError, RuntimeError)
MISTAKES += (HydraException, OmegaConfBaseException)


class JobFailed(Exception):
    """One run of a sweep; what went wrong has been said. The others go on."""


def entry_point(config_name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Decorates the main function of a script: Hydra in front, one-line errors around it."""

    wanted_whole = _traceback_wanted()

    def decorate(main: Callable[[DictConfig], None]) -> Callable[[], None]:
        def run(config: DictConfig) -> None:
            try:
                with exit_on_signal():
                    expand_home(config)
                    main(config)
            except BaseException as error:
                stop = _first(error, (Preempted, KeyboardInterrupt))  # which libraries may answer by errors of their own
                if stop is None and not isinstance(error, Exception) and type(error).__name__ != "PanicException":
                    raise  # PanicException is how libraries in Rust report a damaged file
                _close_bars()
                if isinstance(stop, Preempted):
                    print(stop, file=sys.stderr)
                    raise stop from None
                if stop is not None:
                    _end_interrupted()
                if wanted_whole:
                    traceback.print_exception(error)
                line = f"error: {_one_line(error)}"
                if HydraConfig.get().mode != RunMode.MULTIRUN:
                    sys.exit(line)
                print(f"{line} (job {HydraConfig.get().job.num} of the sweep)", file=sys.stderr)
                raise JobFailed(line) from None

        run.__module__ = main.__module__
        start = hydra.main(config_path=str(CONFIG_DIR), config_name=config_name, version_base="1.3")(run)

        def checked() -> None:
            arguments, left = get_args_parser().parse_known_args()
            if left:
                sys.exit(f"error: {' '.join(left)} is out of place: options such as -m come before all settings.")
            if arguments.multirun and launched():
                sys.exit(SWEEP_OF_PROCESSES)
            if arguments.multirun:
                _let_jobs_import_us()
            os.environ["HYDRA_FULL_ERROR"] = "1"  # lets what Hydra finds wrong, and JobFailed, through to here
            try:
                check_launcher(arguments.overrides)
                plain = [quoted(argument, arguments.multirun) for argument in arguments.overrides]
                replaced = dict(zip(arguments.overrides, check_overrides(config_name, plain)))
                sys.argv[1:] = [replaced.get(argument, argument) for argument in sys.argv[1:]]
                start()
            except JobFailed:
                sys.exit(SWEEP_WITH_FAILURES)
            except KeyboardInterrupt:
                _end_interrupted()
            except Exception as error:
                if wanted_whole:
                    traceback.print_exception(error)
                sys.exit(f"error: {_one_line(error)}")

        return checked

    return decorate


def _traceback_wanted() -> bool:
    return "1" in (os.environ.get("HYDRA_FULL_ERROR"), os.environ.get("FICREG_TRACEBACK"))


def _first(error: BaseException, kinds: tuple[type[BaseException], ...]) -> BaseException | None:
    """The error itself or one that it came after, if it is of one of the kinds."""
    seen = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, kinds):
            return error
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return None


def _end_interrupted() -> None:
    """Ends the process with the exit code that a shell shows for Ctrl-C."""
    print(INTERRUPTED, file=sys.stderr)
    sys.exit(128 + signal.SIGINT)


def expand_home(config: DictConfig) -> None:
    """Puts the home folder in the place of ``~`` in all settings that name files or folders."""
    for key in PATHS:
        value = OmegaConf.select(config, key, throw_on_missing=False)
        if isinstance(value, str) and value.startswith("~"):
            OmegaConf.update(config, key, os.path.expanduser(value))


def quoted(argument: str, sweep: bool = False) -> str:
    """An argument as Hydra reads it whole: a path with signs of Hydra's grammar in it gets quotation marks.

    Args:
        argument: ``key=value`` from the command line.
        sweep: commas part the values of a sweep, and are none of a path's own.

    Raises:
        ValueError: Hydra cannot read the argument; the message shows how to quote it.

    Examples:
        >>> quoted("source=/data/run (1).h5")
        'source="/data/run (1).h5"'
    """
    key, equals, value = argument.partition("=")
    marked = f'{key}="' + value.replace('"', '\\"') + '"'
    is_path = equals and key in PATHS and value[:1] not in "\"'"
    try:
        parsed = OverridesParser.create().parse_override(argument)
    except HydraException as error:
        if is_path:
            return marked
        if not equals:
            raise ValueError(f"{argument!r} cannot be read: settings are written name=value.") from error
        raise ValueError(f"{argument!r} cannot be read: quote the value for the shell and for Hydra, '{marked}'.") from error
    whole = sweep and parsed.is_sweep_override() or parsed.value() is None or isinstance(parsed.value(), str)
    return marked if is_path and not (whole and value == value.strip()) else argument


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


def check_overrides(config_name: str, arguments: list[str]) -> list[str]:
    """Refuses fields that no configuration file declares, and values of another kind.

    A mapping that the files declare empty, such as ``collect.options``, takes any fields.

    Returns:
        the arguments as Hydra accepts them: those of such a mapping are marked ``++``.

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
                near = difflib.get_close_matches(str(override.value()), options, n=1)
                hint = f"did you mean {near[0]}? Choose" if near else "choose"
                raise ValueError(f"{override.key_or_group}={override.value()} is unknown: {hint} one of {options}.")
    with initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
        declared = compose(config_name, chosen)
    known, accepted = [*sorted(groups), *(path for path, _ in _leaves(declared))], list(arguments)
    for number, override in enumerate(overrides):
        key = override.key_or_group
        if key in groups or key.startswith(("hydra.", "hydra/")):  # Hydra checks its own
            continue
        free = _free_mapping(declared, key)
        if free is not None and not override.is_delete():
            if key == free:
                _check_value(declared, key, override)
            accepted[number] = "++" + arguments[number].lstrip("+")
            continue
        if override.is_add() or override.is_delete() or not _declares(declared, key):
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.3)
            hint = f"did you mean {near[0]!r}?" if near else f"see {CONFIG_DIR.name}/{config_name}.yaml."
            raise ValueError(f"{override.input_line!r}: there is no field {key!r} to change; {hint}")
        _check_value(declared, key, override)
    return accepted


def _free_mapping(config: DictConfig, key: str) -> str | None:
    """The mapping that is declared empty and holds a field, or is it; None where there is none."""
    parts = key.split(".")
    for length in range(1, len(parts) + 1):
        path = ".".join(parts[:length])
        if not _declares(config, path):
            return None
        node = OmegaConf.select(config, path, throw_on_missing=False)
        if isinstance(node, DictConfig) and not node:
            return path
    return None


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
        same = isinstance(value, dict if isinstance(present, DictConfig) else list)
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


def _one_line(error: BaseException) -> str:
    """What to say of an error: its message, and its kind where that is no message of ours; one line of bounded length."""
    text = error.args[0] if isinstance(error, KeyError) and error.args else error
    line, kind = " ".join(str(text).split()), type(error).__name__
    line = line if len(line) <= MOST_CHARACTERS else f"{line[: MOST_CHARACTERS - 3]}..."
    if isinstance(error, KeyError) and " " not in line:
        line = f"{kind}: {text!r}"
    elif not isinstance(error, MISTAKES) or isinstance(error, RecursionError) or not line:
        line = f"{kind}: {line}" if line else kind
    else:
        return line
    return f"{line} (FICREG_TRACEBACK=1 shows where)"
