"""Evaluation of a world model: success rates of planning on frozen start-goal pairs, and latent distances."""

from torchrl_ficreg.evaluation.metrics import DistanceProfile, latent_distance, rank_correlation, wilson_interval
from torchrl_ficreg.evaluation.mpc import evaluate_mpc, Evaluation, UniformPolicy
from torchrl_ficreg.evaluation.pairs import StartGoalPairs
from torchrl_ficreg.evaluation.plots import plot_latent_distance, plot_learning_curve, save_episodes_gif

__all__ = [
    "DistanceProfile",
    "Evaluation",
    "StartGoalPairs",
    "UniformPolicy",
    "evaluate_mpc",
    "latent_distance",
    "plot_latent_distance",
    "plot_learning_curve",
    "rank_correlation",
    "save_episodes_gif",
    "wilson_interval",
]
