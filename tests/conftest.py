"""Shared by all tests."""
from __future__ import annotations

pytest_plugins = ["plugin_bus_summary"]
