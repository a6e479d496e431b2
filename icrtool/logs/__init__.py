"""Bytes to tables and back: the only package that opens a log, and the only one that knows ENU."""

from icrtool.logs.read_log import Survey, assemble, read_log, survey_log

__all__ = ["Survey", "assemble", "read_log", "survey_log"]
