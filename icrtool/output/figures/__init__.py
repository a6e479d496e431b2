"""Results as figures. The only package that imports matplotlib: it does so when it is imported itself."""

import logging

from icrtool.errors import OutputError

_logger = logging.getLogger("matplotlib")
_level = _logger.level
# What matplotlib prints about a home directory that it cannot write is of no use to the reader of a report.
_logger.setLevel(logging.ERROR)
try:
    import matplotlib.font_manager  # noqa: F401
except (OSError, UnicodeDecodeError) as err:
    raise OutputError(
        "matplotlibrc", f"matplotlib cannot read its settings: {err}", "mend or remove that file"
    ) from err
_logger.setLevel(_level)
