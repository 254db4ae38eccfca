"""Converts episodes of other formats: python convert.py source=pusht_expert_train.h5 target=data/pusht env=push_t.

The same command continues an interrupted conversion.
"""

from __future__ import annotations

import warnings

from cli import entry_point
from omegaconf import DictConfig, ListConfig, OmegaConf

from torchrl_ficreg.data import EpisodeStore
from torchrl_ficreg.data.convert import convert, open_source, TASKS


@entry_point("convert")
def main(cfg: DictConfig) -> None:
    """Converts missing episodes and prints the number of all."""
    if missing := sorted(OmegaConf.missing_keys(cfg)):
        raise ValueError(f"name {' and '.join(missing)}: source=pusht_expert_train.h5 target=data/pusht, say.")
    # One line, without the source line of the warning.
    warnings.showwarning = lambda message, *_: print(f"warning: {message}")
    if cfg.env_name and cfg.env is not None:
        raise ValueError(f"env_name={cfg.env_name} is for environments other than env={cfg.env.name}: give one of them.")
    if (cfg.action_low is None) != (cfg.action_high is None):
        raise ValueError("give both action_low and action_high, or none of them.")
    task = OmegaConf.to_container(cfg.env) if cfg.env is not None else {"name": cfg.env_name, "kwargs": {}}
    state = list(cfg.state) if isinstance(cfg.state, ListConfig) else cfg.state
    if "detail" in task["kwargs"]:
        task["kwargs"]["detail"] = "published"  # the default is that of our own recordings
    with open_source(
        cfg.source,
        cfg.format,
        env=task["name"],
        state=state,
        pixels=cfg.pixels,
        action=cfg.action,
        shift=cfg.shift,
        allow_incomplete=cfg.allow_incomplete,
        skip_bad_episodes=cfg.skip_bad_episodes,
    ) as source:
        path = convert(
            source,
            cfg.target,
            env_kwargs=task["kwargs"],
            action_bounds=None if cfg.action_low is None else (cfg.action_low, cfg.action_high),
            frames=cfg.frames,
            image_size=cfg.image_size,
            limit=cfg.limit,
            check_alignment=cfg.check_alignment,
        )
    store = EpisodeStore.open(path)
    if task["name"] is None or task["name"] not in TASKS:
        warnings.warn(
            f"{path} is of an environment that this package cannot build: train.py, evaluate.py and collect.py plan and "
            "measure in env=" + ", ".join(sorted(TASKS)) + "; train on the dataset from Python (OfflineTrajectories)."
        )
    print(f"{path}: {store.num_episodes} episodes, {store.num_steps} steps")


if __name__ == "__main__":
    main()
