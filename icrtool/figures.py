"""Figures of runs and reports, each returned as a matplotlib Figure; imported when first used.

With ``ax=``, axes of matplotlib, a function draws into these axes and returns them; fonts and the other settings are
then those of the caller. A figure of several panels divides the place of the axes. No call changes matplotlib's
settings.
"""

from icrtool.output.figures.dropout_errors import dropout_histogram, dropout_histograms, dropout_summary
from icrtool.output.figures.dropout_paths import dropout_examples, dropout_map, dropout_outages, dropout_worst
from icrtool.output.figures.filter_estimates import gnss_difference, icr_clusters, icr_estimates
from icrtool.output.figures.trajectory import trajectory

__all__ = [
    "dropout_examples",
    "dropout_histogram",
    "dropout_histograms",
    "dropout_map",
    "dropout_outages",
    "dropout_summary",
    "dropout_worst",
    "gnss_difference",
    "icr_clusters",
    "icr_estimates",
    "trajectory",
]
