"""Figures of runs and reports, each returned as a matplotlib Figure; imported when first used."""

from icrtool.output.figures.dropout_errors import dropout_histogram, dropout_histograms, dropout_summary
from icrtool.output.figures.dropout_paths import dropout_examples, dropout_outages, dropout_worst
from icrtool.output.figures.filter_estimates import gnss_difference, icr_clusters, icr_estimates
from icrtool.output.figures.trajectory import trajectory

__all__ = [
    "dropout_examples",
    "dropout_histogram",
    "dropout_histograms",
    "dropout_outages",
    "dropout_summary",
    "dropout_worst",
    "gnss_difference",
    "icr_clusters",
    "icr_estimates",
    "trajectory",
]
