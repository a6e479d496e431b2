"""Convert logs to tables and tables to logs. Only this package opens a log, and only this package converts ENU."""
