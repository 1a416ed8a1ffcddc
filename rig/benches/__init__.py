"""Benches: which device is under test, how it talks, and what its numbers mean; the shipped ones as files."""
