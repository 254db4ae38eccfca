"""Evaluation of a world model: success rates on frozen start-goal pairs, latent distances, probes, planning with true dynamics."""

from torchrl_ficreg.evaluation.metrics import DistanceProfile, latent_distance, rank_correlation, wilson_interval
from torchrl_ficreg.evaluation.mpc import evaluate_mpc, Evaluation, UniformPolicy
from torchrl_ficreg.evaluation.oracle import DrawnGoalDistance, oracle_policy, Simulator, StateDistance
from torchrl_ficreg.evaluation.pairs import StartGoalPairs
from torchrl_ficreg.evaluation.plots import plot_latent_distance, plot_learning_curve, save_episodes_gif
from torchrl_ficreg.evaluation.probes import measure_states, Quantity, state_quantities, StateProbe

__all__ = [
    "DistanceProfile",
    "DrawnGoalDistance",
    "Evaluation",
    "Quantity",
    "Simulator",
    "StartGoalPairs",
    "StateDistance",
    "StateProbe",
    "UniformPolicy",
    "evaluate_mpc",
    "latent_distance",
    "measure_states",
    "oracle_policy",
    "plot_latent_distance",
    "plot_learning_curve",
    "rank_correlation",
    "save_episodes_gif",
    "state_quantities",
    "wilson_interval",
]
