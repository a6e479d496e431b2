"""Filters and smoothers, event by event."""
