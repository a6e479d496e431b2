"""Results as figures. The only package that imports matplotlib: it does so when it is imported itself."""

import logging

_logger = logging.getLogger("matplotlib")
_level = _logger.level
# What matplotlib prints about a home directory that it cannot write is of no use to the reader of a report.
_logger.setLevel(logging.ERROR)
import matplotlib.font_manager  # noqa: E402, F401

_logger.setLevel(_level)
