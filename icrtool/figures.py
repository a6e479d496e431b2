"""Figures of runs and reports, each returned as a matplotlib Figure; imported when first used."""

from icrtool.output.figures.catalogue import (
    dropout_examples,
    dropout_histogram,
    dropout_outages,
    dropout_summary,
    dropout_worst,
    gnss_difference,
    icr_clusters,
    icr_estimates,
    model_comparison,
    trajectory,
)

__all__ = [
    "dropout_examples",
    "dropout_histogram",
    "dropout_outages",
    "dropout_summary",
    "dropout_worst",
    "gnss_difference",
    "icr_clusters",
    "icr_estimates",
    "model_comparison",
    "trajectory",
]
