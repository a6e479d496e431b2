"""Conversion of logs to tables and of tables to logs. No other package opens a log or converts from ENU."""
