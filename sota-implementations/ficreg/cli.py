"""The command line of the scripts: Hydra, paths taken as typed, and every error in one line.

A mistake in the settings ends with exit code 2, any other error with 1, a stop by SIGTERM with 85 and by Ctrl-C with 130.
"""

from __future__ import annotations

import difflib
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import hydra
from configs import check_ranges, SettingError
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from run_dir import flatten
from tqdm import tqdm

from torchrl_ficreg.distributed import torchrun_world_size
from torchrl_ficreg.trainers import exit_on_signal, Preempted

CONFIG_DIR = Path(__file__).resolve().parent / "config"
PATHS = ("source", "target", "dataset", "data_dir", "runs_dir", "resume", "checkpoint", "pairs", "output", "plan.policy")
FREE = ("env.kwargs", "env.data.kwargs", "env.data.expert")  # arguments of constructors: any names
LAUNCHERS = {"joblib": "sweep", "submitit_slurm": "slurm", "submitit_local": "slurm"}  # and the extra each needs
MAX_CHARACTERS = 1000  # of an error message: some libraries quote whole files

# Exceptions caused by wrong settings or data: their messages are printed alone, those of others after their type.
USER_ERRORS = (ValueError, TypeError, KeyError, ImportError, OSError, FloatingPointError, RuntimeError)
USER_ERRORS += (HydraException, OmegaConfBaseException)


class JobFailed(Exception):
    """One run of a sweep failed, and its error has been printed; the other runs go on."""


def entry_point(config_name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Decorates the main function of a script: its configuration comes from Hydra, its errors are one line each."""

    def decorate(main: Callable[[DictConfig], None]) -> Callable[[], None]:
        def run(config: DictConfig) -> None:
            try:
                with exit_on_signal():
                    check_ranges(config)
                    expand_home(config)
                    main(config)
            except BaseException as error:
                stop = _first(error, (Preempted, KeyboardInterrupt))  # libraries may raise errors of their own after it
                if stop is None and not isinstance(error, Exception) and type(error).__name__ != "PanicException":
                    raise  # PanicException: libraries in Rust raise it for a damaged file
                for bar in list(getattr(tqdm, "_instances", [])):
                    bar.close()  # the message gets a line of its own
                if isinstance(stop, Preempted):
                    print(stop, file=sys.stderr)
                    raise stop from None
                if stop is not None:
                    _exit_interrupted()
                _print_traceback(error)
                if HydraConfig.get().mode != RunMode.MULTIRUN:
                    _fail(one_line(error), 2 if isinstance(error, SettingError) else 1)
                print(f"error: {one_line(error)} (job {HydraConfig.get().job.num} of the sweep)", file=sys.stderr)
                raise JobFailed from None

        run.__module__ = main.__module__
        start = hydra.main(config_path=str(CONFIG_DIR), config_name=config_name, version_base="1.3")(run)

        def checked() -> None:
            sweep = not {"-m", "--multirun"}.isdisjoint(sys.argv[1:])
            if os.environ.get("HYDRA_FULL_ERROR") == "1":
                os.environ["FICREG_TRACEBACK"] = "1"
            os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises its errors, and JobFailed, instead of printing them
            try:
                if sweep and torchrun_world_size() > 1:
                    raise SettingError(
                        "under torchrun a sweep is one command for each run: start torchrun once per seed, or use -m with "
                        "hydra/launcher=slurm."
                    )
                if sweep:
                    _export_script_path()
                sys.argv[1:] = prepare(sys.argv[1:], sweep)
                start()
            except JobFailed:
                _fail("not all runs of the sweep succeeded; the same command leaves those that did as they are.", 1)
            except KeyboardInterrupt:
                _exit_interrupted()
            except Exception as error:
                _print_traceback(error)
                settings = isinstance(error, (SettingError, HydraException, OmegaConfBaseException))
                _fail(explain(error, config_name, sys.argv[1:]), 2 if settings else 1)

        return checked

    return decorate


def prepare(arguments: list[str], sweep: bool = False) -> list[str]:
    """Arguments as Hydra accepts them: paths quoted, ``+`` only where any name is accepted.

    Raises:
        SettingError: an option between settings, a setting to be removed, or an unknown choice of a group.

    Examples:
        >>> prepare(["source=/data/run (1).h5", "env.kwargs.wrap=true"])
        ['source="/data/run (1).h5"', '++env.kwargs.wrap=true']
    """
    options = [number for number, argument in enumerate(arguments) if argument.startswith("-")]
    for number in options:
        if any("=" in argument for argument in arguments[:number]) and any("=" in a for a in arguments[number + 1 :]):
            after = " ".join(argument for argument in arguments[number + 1 :] if not argument.startswith("-"))
            raise SettingError(f"{after} is out of place: options such as {arguments[number]} come before all settings.")
    prepared = []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        name = key.lstrip("+")
        if key.startswith(("-", "hydra", "+hydra", "++hydra")) or not equals and not key.startswith("~"):
            prepared.append(argument)
        elif key.startswith("~"):
            raise SettingError(f"{argument!r}: a field cannot be removed; give it another value.")
        elif any(name == free or name.startswith(f"{free}.") for free in FREE):
            prepared.append(f"++{name}={value}")
        elif name in PATHS and value not in ("", "null") and value[:1] not in "\"'" and not (sweep and "," in value):
            quoted = value.replace('"', '\\"')
            prepared.append(f'{name}="{quoted}"')
        else:
            if (CONFIG_DIR / name).is_dir() and "," not in value:
                _check_choice(name, value)
            prepared.append(f"{name}={value}")
    return prepared


def _check_choice(group: str, choice: str) -> None:
    """Refuses a file that a group does not have, also where the group is optional."""
    options = sorted(path.stem for path in (CONFIG_DIR / group).glob("[!_]*.yaml"))
    if choice not in options:
        near = difflib.get_close_matches(choice, options, n=1)
        hint = f"did you mean {near[0]}? Choose" if near else "choose"
        raise SettingError(f"{group}={choice} is unknown: {hint} one of {options}.")


def expand_home(config: DictConfig) -> None:
    """Replaces ``~`` by the home folder in all settings that name files or folders."""
    for key in PATHS:
        value = OmegaConf.select(config, key, throw_on_missing=False)
        if isinstance(value, str) and value.startswith("~"):
            OmegaConf.update(config, key, os.path.expanduser(value))


def explain(error: Exception, config_name: str, arguments: list[str]) -> str:
    """What an error of Hydra means for the user; other errors by :func:`one_line`."""
    if isinstance(error, MissingConfigException):
        name = Path(error.missing_cfg_file or "").name
        if name in LAUNCHERS:
            return f"hydra/launcher needs a package for {name}: pip install 'torchrl_ficreg[{LAUNCHERS[name]}]'."
    if isinstance(error, OverrideParseException):
        setting, equals, value = error.override.partition("=")
        if not equals:
            return f"{error.override!r} cannot be read: settings are written name=value."
        return f"{error.override!r} cannot be read: quote the value for the shell and for Hydra, '{setting}=\"{value}\"'."
    unknown = re.match(r"Could not override '([^']+)'", str(error)) if isinstance(error, ConfigCompositionException) else None
    if unknown:
        return f"there is no field {unknown[1]!r} to change; {_suggest_field(unknown[1], config_name, arguments)}"
    if isinstance(error, ConfigCompositionException) and error.__cause__ is not None:
        override = str(error).splitlines()[0].removeprefix("Error merging override ").lstrip("+")
        return f"{override!r}: {str(error.__cause__).splitlines()[0].rstrip('.')}."
    return one_line(error)


def _suggest_field(name: str, config_name: str, arguments: list[str]) -> str:
    """The nearest field of the configuration with the chosen groups."""
    groups = [path.name for path in CONFIG_DIR.iterdir() if path.is_dir()]
    chosen = [argument for argument in arguments if argument.partition("=")[0] in groups and "," not in argument]
    with initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
        known = flatten(OmegaConf.to_container(compose(config_name, chosen)))
    near = difflib.get_close_matches(name, [*groups, *known], n=1, cutoff=0.3)
    return f"did you mean {near[0]!r}?" if near else f"see {CONFIG_DIR.name}/{config_name}.yaml."


def one_line(error: BaseException) -> str:
    """The message of an error in one line of bounded length, after its type unless it is one of ``USER_ERRORS``."""
    text = error.args[0] if isinstance(error, KeyError) and error.args else error
    line, kind = " ".join(str(text).split()), type(error).__name__
    line = line if len(line) <= MAX_CHARACTERS else f"{line[: MAX_CHARACTERS - 3]}..."
    if isinstance(error, KeyError) and " " not in line:
        line = f"{kind}: {text!r}"
    elif not isinstance(error, USER_ERRORS) or isinstance(error, RecursionError) or not line:
        line = f"{kind}: {line}" if line else kind
    else:
        return line
    return f"{line} (FICREG_TRACEBACK=1 shows where)"


def _print_traceback(error: BaseException) -> None:
    if os.environ.get("FICREG_TRACEBACK") == "1":
        traceback.print_exception(error)


def _fail(line: str, code: int) -> NoReturn:
    print(f"error: {line}", file=sys.stderr)
    sys.exit(code)


def _exit_interrupted() -> NoReturn:
    print("interrupted: the same command continues from what is on disk.", file=sys.stderr)
    sys.exit(128 + signal.SIGINT)


def _first(error: BaseException | None, kinds: tuple[type[BaseException], ...]) -> BaseException | None:
    """The first error of one of the kinds in the chain of an error's causes."""
    seen = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, kinds):
            return error
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return None


def _export_script_path() -> None:
    """Lets the processes of a sweep, which unpickle the job, import the modules of this folder."""
    inherited = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(CONFIG_DIR.parent), *([inherited] if inherited else [])])
