"""train.py, which does without its pictures where matplotlib or imageio is missing: python train_bare.py OVERRIDES."""

from __future__ import annotations

import functools
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

TRAIN = Path(__file__).resolve().parents[1] / "sota-implementations" / "ficreg" / "train.py"
PICTURES = ("plot_learning_curve", "plot_latent_distance", "save_episodes_gif")


def main() -> None:
    """Runs train.py in this process."""
    from torchrl_ficreg import evaluation

    for name in PICTURES:
        setattr(evaluation, name, if_it_can(getattr(evaluation, name)))
    sys.path.insert(0, str(TRAIN.parent))
    sys.argv[0] = str(TRAIN)
    runpy.run_path(str(TRAIN), run_name="__main__")


def if_it_can(draw: Callable[..., object]) -> Callable[..., None]:
    """The same function, which says in a line that a package is missing instead of raising."""

    @functools.wraps(draw)
    def attempt(*args: object, **kwargs: object) -> None:
        try:
            draw(*args, **kwargs)
        except ImportError as error:
            print(f"picture skipped: {error}", file=sys.stderr)

    return attempt


if __name__ == "__main__":
    main()
