"""Environment variables for the moment: for a process that is started, or a module that is loaded, meanwhile."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

ONE_THREAD = {  # read when a library is loaded, before any code of a worker process could say so
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",  # Mesa's software GL: helpers beside the thread that draws
}


@contextlib.contextmanager
def environment_variables(variables: dict[str, str]) -> Iterator[None]:
    """Sets some variables, and puts the former ones back at the end.

    Args:
        variables: name -> value.

    Examples:
        >>> with environment_variables({"TORCHRL_FICREG_EXAMPLE": "1"}):
        ...     "TORCHRL_FICREG_EXAMPLE" in os.environ
        True
        >>> "TORCHRL_FICREG_EXAMPLE" in os.environ
        False
    """
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
