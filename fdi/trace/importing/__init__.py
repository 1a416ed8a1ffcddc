"""Recordings of other loggers: a map says which column is which signal, and the import makes a trace of it."""
