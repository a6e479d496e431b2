"""Results as figures. Only this package imports matplotlib; importing this package imports it."""

import logging

from icrtool.errors import OutputError

_logger = logging.getLogger("matplotlib")
_level = _logger.level
# matplotlib's messages about a home directory that it cannot write do not help the reader of a report.
_logger.setLevel(logging.ERROR)
try:
    import matplotlib.font_manager  # noqa: F401
except (OSError, UnicodeDecodeError) as err:
    raise OutputError(
        "matplotlibrc", f"matplotlib cannot read its settings: {err}", "mend or remove that file"
    ) from err
_logger.setLevel(_level)
